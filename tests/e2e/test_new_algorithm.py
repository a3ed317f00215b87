"""A beginner's walk: copy an algorithm, take its exam, change five lines, train, resume, play."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from scilab_rl.cli import run_command_line

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
            "        self.learning_rate = learning_rate\n",
            "        self.learning_rate = learning_rate\n        self.action_cost = action_cost\n",
        ),
        (
            "            batch = self.sample(self.batch_size)\n",
            "            batch = self.sample(self.batch_size)\n"
            "            cost = self.action_cost * batch.actions.square().sum(1, keepdim=True)\n"
            "            batch = batch._replace(rewards=batch.rewards - cost)\n"
            '            self.logger.record("train/action_cost", cost.mean())\n',
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
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is all that somebody has who installed with pip."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))  # the desk joins it
    return tmp_path


@pytest.mark.slow
def test_from_a_copy_to_a_trained_idea(desk: Path) -> None:
    made = scilab_rl("new", "algorithm", "gentle", "--from", "cleansac", cwd=desk)
    assert made.returncode == 0, made.stderr
    exam = take_exam(desk, "gentle")
    assert exam.returncode == 0, exam.stdout
    assert " passed" in exam.stdout

    for name, changes in CHANGES.items():
        text = (desk / name).read_text()
        for old, new in changes:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (desk / name).write_text(text)

    arguments = (
        "algorithm=gentle",
        TINY,
        *QUICK[1:],
        "eval_after_n_steps=500",
        "save_model_freq=500",
    )
    trained = scilab_rl(*arguments, "n_epochs=4", cwd=desk, timeout=300)
    assert trained.returncode == 0, trained.stderr
    run = last_run(desk)
    result = json.loads((run / "result.json").read_text())
    assert (result["status"], result["steps"]) == ("finished", 2000)
    assert "train/action_cost" in (run / "metrics.csv").read_text().splitlines()[0]

    resumed = scilab_rl("resume", "last", "n_epochs=5", cwd=desk, timeout=300)
    assert resumed.returncode == 0, resumed.stderr
    assert json.loads((run / "result.json").read_text())["steps"] == 2500
    played = scilab_rl("play", "last", "--episodes", "3", cwd=desk)
    assert played.returncode == 0, played.stderr
    assert "algorithm: gentle" in played.stdout
    assert "95 % interval" in played.stdout


@pytest.mark.slow
@pytest.mark.parametrize("parent", ["cleanppo", "sac", "td3", "ddpg", "dqn", "crossq", "ppo"])
def test_copy_takes_its_exam_unchanged(parent: str, desk: Path) -> None:
    made = scilab_rl("new", "algorithm", "idea", "--from", parent, cwd=desk)
    assert made.returncode == 0, made.stderr
    exam = take_exam(desk, "idea", "-m", "not slow")
    assert exam.returncode == 0, exam.stdout


def test_what_is_written(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command_line(["new", "algorithm", "sac_var2", "--from", "sac"]) == 0
    printed = capsys.readouterr().out
    assert "python -m pytest tests/test_sac_var2.py" in printed
    assert "scilab-rl algorithm=sac_var2 env=FetchReach" in printed
    assert files_in(desk) == [
        "conf/algorithm/sac_var2.yaml",
        "src/custom_algorithms/__init__.py",
        "src/custom_algorithms/sac_var2.py",
        "tests/test_sac_var2.py",
    ]
    shipped = Path(sys.modules["scilab_rl"].__file__).parent / "conf" / "algorithm" / "sac.yaml"
    expected = yaml.safe_load(shipped.read_text())
    expected |= {"name": "sac_var2", "_target_": "custom_algorithms.sac_var2.SAC_VAR2"}
    text = (desk / "conf/algorithm/sac_var2.yaml").read_text()
    assert list(yaml.safe_load(text).items()) == list(expected.items())
    assert "# auto, auto_0.1 (initial value) or a fixed number" in text  # comments stay


def test_only_names_differ_from_the_parent(desk: Path) -> None:
    import inspect

    from stable_baselines3.sac import sac

    assert run_command_line(["new", "algorithm", "calm", "--from", "sac"]) == 0
    copy = (desk / "src/custom_algorithms/calm.py").read_text().splitlines()
    parent = inspect.getsource(sac).splitlines()
    added = [line for line in copy if line not in parent]
    assert added == [
        copy[0],
        'SelfCALM = TypeVar("SelfCALM", bound="CALM")',
        "class CALM(OffPolicyAlgorithm):",
        "    supported_action_spaces = (spaces.Box,)",
        "        self: SelfCALM,",
        '        tb_log_name: str = "CALM",',
        "    ) -> SelfCALM:",
    ]
    assert copy[0].startswith("# A copy of stable_baselines3/sac/sac.py (stable_baselines3 2.")
    assert "MIT licence" in copy[0]
    assert "Soft Actor-Critic (SAC)" in "\n".join(copy)  # prose stays


@pytest.mark.parametrize(
    ("parent", "env"), [("dqn", "CartPole-v1"), ("crossq", "Pendulum-v1"), ("td3", "FetchReach")]
)
def test_suggested_environment_fits(
    parent: str, env: str, desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command_line(["new", "algorithm", "idea", "--from", parent]) == 0
    assert f"algorithm=idea env={env}" in capsys.readouterr().out


def test_a_copy_of_a_copy(desk: Path) -> None:
    """The desk's own algorithms are parents too; in a process of its own, as a user does it."""
    for name, parent in (("first", "cleanppo"), ("second", "first")):
        made = scilab_rl("new", "algorithm", name, "--from", parent, cwd=desk)
        assert made.returncode == 0, made.stderr
    source = (desk / "src/custom_algorithms/second.py").read_text()
    assert source.startswith("# A copy of custom_algorithms/first.py.")
    assert "class SECOND(OneFileAlgorithm):" in source
    listed = scilab_rl("algorithms", "--json", cwd=desk)
    rows = {row["algorithm"]: row for row in json.loads(listed.stdout)}
    assert rows["second"]["class"] == "custom_algorithms.second.SECOND"
    assert rows["second"]["problem"] is None


REFUSED = [
    (["sac"], "There is an algorithm 'sac' already (shipped)"),
    (["mine"], "There is an algorithm 'mine' already (yours)"),
    (["class"], "a word of Python"),
    (["none"], "a word of Python"),
    (["null"], "no text in YAML"),
    (["on"], "no text in YAML"),
    (["nan"], "no text in YAML"),
    (["../idea"], "no path"),
    (["folder/idea"], "no path"),
    (["/tmp/idea"], "no path"),
    (["idea.py"], "no name for an algorithm"),
    (["2nd_idea"], "no name for an algorithm"),
    (["my-idea"], "no name for an algorithm"),
    (["MyIdea"], "no name for an algorithm"),
    (["_idea"], "no name for an algorithm"),
    (["ideä"], "no name for an algorithm"),
    ([""], "no name for an algorithm"),
    (["i" * 61], "no name for an algorithm"),
    (["f"], "would hide F"),
    (["idea", "--from", "sacc"], "Did you mean 'sac'?"),
    (["idea", "--form", "sac"], "Did you mean '--from'?"),
    ([], "required: name"),
    (["package"], "'src/custom_algorithms/package' exists already"),
    (["examined"], "'tests/test_examined.py' exists already"),
]


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_refused_names_write_nothing(
    words: list[str], message: str, desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (desk / "conf/algorithm").mkdir(parents=True)
    (desk / "conf/algorithm/mine.yaml").write_text(
        "name: mine\n_target_: custom_algorithms.mine.M\n"
    )
    (desk / "src/custom_algorithms/package").mkdir(parents=True)
    (desk / "tests").mkdir()
    (desk / "tests/test_examined.py").touch()
    before = files_in(desk)
    assert run_command_line(["new", "algorithm", *words]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert files_in(desk) == before


def test_nothing_stays_when_a_file_cannot_be_written(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (desk / "tests").touch()  # no folder can be made here
    assert run_command_line(["new", "algorithm", "idea"]) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert files_in(desk) == ["tests"]
