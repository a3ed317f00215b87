"""A beginner's walk: copy an algorithm, test it, change five lines, train, resume, play."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from scilab_rl.cli.main import run_command_line

from .commands import QUICK, TINY, last_run, quiet_environment, scilab_rl

# The idea: the agent is also rewarded for acting gently, r = r_e - cost |a|^2.
CHANGES = {
    "src/custom_algorithms/gentle.py": [
        (
            "        intrinsic: str | Mapping[str, Any] | None = None,\n",
            "        intrinsic: str | Mapping[str, Any] | None = None,\n"
            "        action_cost: float = 0.1,\n",
        ),
        (
            "        self.n_critics = n_critics\n",
            "        self.n_critics = n_critics\n        self.action_cost = action_cost\n",
        ),
        (
            "        actions, log_prob = self.actor.sample(batch.observations)\n",
            "        cost = self.action_cost * batch.actions.square().sum(1, keepdim=True)\n"
            "        batch = batch._replace(rewards=batch.rewards - cost)\n"
            '        self.logger.record("train/action_cost", cost.mean())\n'
            "        actions, log_prob = self.actor.sample(batch.observations)\n",
        ),
    ],
    "conf/algorithm/gentle.yaml": [
        ("gamma: 0.99\n", "gamma: 0.99\naction_cost: 0.1  # per squared length of an action\n")
    ],
}


def files_in(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def take_exam(folder: Path, name: str, *options: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error"]
    command += ["-W", "ignore::pytest.PytestUnknownMarkWarning"]  # no pyproject.toml here
    return subprocess.run(
        [*command, *options, f"tests/test_{name}.py"], cwd=folder, capture_output=True, text=True,
        timeout=600, env=quiet_environment(), check=False,
    )  # fmt: skip


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is all that somebody has who installed with pip."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))  # the project folder joins it
    return tmp_path


@pytest.mark.slow
def test_from_a_copy_to_a_trained_idea(project: Path) -> None:
    made = scilab_rl("new", "algorithm", "gentle", "--from", "cleansac", cwd=project)
    assert made.returncode == 0, made.stderr
    contract = take_exam(project, "gentle")
    assert contract.returncode == 0, contract.stdout
    assert " passed" in contract.stdout

    for name, changes in CHANGES.items():
        text = (project / name).read_text()
        for old, new in changes:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (project / name).write_text(text)

    arguments = (
        "algorithm=gentle",
        TINY,
        *QUICK[1:],
        "eval_after_n_steps=500",
        "save_model_freq=500",
    )
    trained = scilab_rl(*arguments, "n_epochs=4", cwd=project, timeout=300)
    assert trained.returncode == 0, trained.stderr
    run = last_run(project)
    result = json.loads((run / "result.json").read_text())
    assert (result["status"], result["steps"]) == ("finished", 2000)
    assert "train/action_cost" in (run / "metrics.csv").read_text().splitlines()[0]

    resumed = scilab_rl("resume", "last", "n_epochs=5", cwd=project, timeout=300)
    assert resumed.returncode == 0, resumed.stderr
    assert json.loads((run / "result.json").read_text())["steps"] == 2500
    played = scilab_rl("play", "last", "--episodes", "3", cwd=project)
    assert played.returncode == 0, played.stderr
    assert "algorithm: gentle" in played.stdout
    assert "95 % interval" in played.stdout


@pytest.mark.slow
@pytest.mark.parametrize("parent", ["cleanppo", "sac", "td3", "ddpg", "dqn", "crossq", "ppo"])
def test_copy_takes_its_exam_unchanged(parent: str, project: Path) -> None:
    made = scilab_rl("new", "algorithm", "idea", "--from", parent, cwd=project)
    assert made.returncode == 0, made.stderr
    contract = take_exam(project, "idea", "-m", "not slow")
    assert contract.returncode == 0, contract.stdout


def test_what_is_written(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command_line(["new", "algorithm", "sac_var2", "--from", "sac"]) == 0
    printed = capsys.readouterr().out
    assert "python -m pytest tests/test_sac_var2.py" in printed
    assert "scilab-rl algorithm=sac_var2 env=FetchReach" in printed
    assert files_in(project) == [
        "conf/algorithm/sac_var2.yaml",
        "src/custom_algorithms/__init__.py",
        "src/custom_algorithms/sac_var2.py",
        "tests/test_sac_var2.py",
    ]
    shipped = Path(sys.modules["scilab_rl"].__file__).parent / "conf" / "algorithm" / "sac.yaml"
    expected = yaml.safe_load(shipped.read_text())
    expected |= {"name": "sac_var2", "_target_": "custom_algorithms.sac_var2.SAC_VAR2"}
    text = (project / "conf/algorithm/sac_var2.yaml").read_text()
    assert list(yaml.safe_load(text).items()) == list(expected.items())
    assert "# auto, auto_0.1 (initial value) or a fixed number" in text  # comments stay


def test_only_names_differ_from_the_parent(project: Path) -> None:
    import inspect

    from stable_baselines3.sac import sac

    assert run_command_line(["new", "algorithm", "calm", "--from", "sac"]) == 0
    copy = (project / "src/custom_algorithms/calm.py").read_text().splitlines()
    parent = inspect.getsource(sac).splitlines()
    added = [line for line in copy if line not in parent]
    assert added == [
        copy[0],
        'SelfCALM = TypeVar("SelfCALM", bound="CALM")',
        "class CALM(OffPolicyAlgorithm):",
        "    supported_action_spaces = (spaces.Box,)",
        "    metrics = (",
        *(
            f'        "train/{name}",'
            for name in ("n_updates", "learning_rate", "actor_loss", "critic_loss", "ent_coef")
        ),
        '        ("train/ent_coef_loss", "ent_coef is auto"),',
        "    )",
        "        self: SelfCALM,",
        '        tb_log_name: str = "CALM",',
        "    ) -> SelfCALM:",
    ]
    assert copy[0].startswith("# A copy of stable_baselines3/sac/sac.py (stable_baselines3 2.")
    assert "MIT license" in copy[0]
    assert "Soft Actor-Critic (SAC)" in "\n".join(copy)  # prose stays


@pytest.mark.parametrize(
    ("parent", "env"), [("dqn", "CartPole-v1"), ("crossq", "Pendulum-v1"), ("td3", "FetchReach")]
)
def test_suggested_environment_fits(
    parent: str, env: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command_line(["new", "algorithm", "idea", "--from", parent]) == 0
    assert f"algorithm=idea env={env}" in capsys.readouterr().out


def test_a_copy_of_a_copy(project: Path) -> None:
    """A project's own algorithms are parents too; in a new process, as a user does it."""
    for name, parent in (("first", "cleanppo"), ("second", "first")):
        made = scilab_rl("new", "algorithm", name, "--from", parent, cwd=project)
        assert made.returncode == 0, made.stderr
    source = (project / "src/custom_algorithms/second.py").read_text()
    assert source.startswith("# A copy of custom_algorithms/first.py.")
    assert "class SECOND(OneFileAlgorithm):" in source
    listed = scilab_rl("algorithms", "--json", cwd=project)
    rows = {row["algorithm"]: row for row in json.loads(listed.stdout)}
    assert rows["second"]["class"] == "custom_algorithms.second.SECOND"
    assert rows["second"]["problem"] is None


REFUSED = [
    (["sac"], "The algorithm 'sac' already exists (shipped)"),
    (["mine"], "The algorithm 'mine' already exists (yours)"),
    (["class"], "a keyword of Python"),
    (["none"], "a keyword of Python"),
    (["null"], "not read as text by YAML"),
    (["on"], "not read as text by YAML"),
    (["nan"], "not read as text by YAML"),
    (["../idea"], "not a path"),
    (["folder/idea"], "not a path"),
    (["/tmp/idea"], "not a path"),
    (["idea.py"], "not a valid name for an algorithm"),
    (["2nd_idea"], "not a valid name for an algorithm"),
    (["my-idea"], "not a valid name for an algorithm"),
    (["MyIdea"], "not a valid name for an algorithm"),
    (["_idea"], "not a valid name for an algorithm"),
    (["ideä"], "not a valid name for an algorithm"),
    ([""], "not a valid name for an algorithm"),
    (["i" * 61], "not a valid name for an algorithm"),
    (["f"], "would hide F"),
    (["idea", "--from", "sacc"], "Did you mean 'sac'?"),
    (["idea", "--form", "sac"], "Did you mean '--from'?"),
    ([], "required: name"),
    (["package"], "'src/custom_algorithms/package' already exists"),
    (["examined"], "'tests/test_examined.py' already exists"),
]


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_refused_names_write_nothing(
    words: list[str], message: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / "conf/algorithm").mkdir(parents=True)
    (project / "conf/algorithm/mine.yaml").write_text(
        "name: mine\n_target_: custom_algorithms.mine.M\n"
    )
    (project / "src/custom_algorithms/package").mkdir(parents=True)
    (project / "tests").mkdir()
    (project / "tests/test_examined.py").touch()
    before = files_in(project)
    assert run_command_line(["new", "algorithm", *words]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert files_in(project) == before


def test_nothing_stays_when_a_file_cannot_be_written(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / "tests").touch()  # no folder can be made here
    assert run_command_line(["new", "algorithm", "idea"]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert files_in(project) == ["tests"]
