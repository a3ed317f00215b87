"""Wrong input: one line with what to do, exit code 2, and nothing left behind."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from scilab_rl.cli.main import run_command_line

from .commands import (
    QUICK,
    TINY,
    config_of,
    last_run,
    quiet_environment,
    scilab_rl,
    untimed_rows,
)

# What was typed, and the word that has to be suggested.
TYPOS = [
    ("algorithm=sacc", "sac"),
    ("algorithm=td33", "td3"),
    ("algorithm=DDGP", "ddpg"),
    ("algorithm=pp", "ppo"),
    ("algorithm=clensac", "cleansac"),
    ("algorithm=qr_dqn", "qrdqn"),
    ("env=FetchReech-v4", "FetchReach-v4"),
    ("env=fetchpush-v4", "FetchPush-v4"),
    ("env=FetchPickPlace-v4", "FetchPickAndPlace-v4"),
    ("env=CartPol-v1", "CartPole-v1"),
    ("env=Pendulm", "Pendulum-v1"),
    ("env=AntMaze_Umaz-v5", "AntMaze_UMaze-v5"),
    ("n_epoch=3", "n_epochs"),
    ("sead=3", "seed"),
    ("render_frq=1", "render_freq"),
    ("eval_after_steps=100", "eval_after_n_steps"),
    ("early_stop_treshold=0.5", "early_stop_threshold"),
    ("+flaten_obs=1", "flatten_obs"),
    ("algorithm.learning_rat=0.1", "learning_rate"),
    ("++algorithm.bacth_size=8", "batch_size"),
    ("algorithm.gama=0.9", "gamma"),
    ("env_kwargs.reward_typ=dense", "reward_type"),
    ("early_stop_data_column=eval/sucess_rate", "eval/success_rate"),
    ("hyperopt_criterion=eval/mean_rewards", "eval/mean_reward"),
    ("render=recrod", "record"),
    ("vector=subproces", "subprocess"),
    ("plya", "play"),
    ("resum", "resume"),
]

BAD_VALUES = [
    "n_epochs=0",
    "n_epochs=abc",
    "n_epochs=1.5",
    "n_epochs=",
    "seed=-1",
    "n_envs=0",
    "early_stop_threshold=nan",
    "algorithm.gamma=1.5",
    "algorithm.learning_rate=-1",
    "algorithm.learning_rate=fast",
    "algorithm.batch_size=0",
    "algorithm.batch_size=2.5",
    "algorithm._target_=stable_baselines3.SACK",
    "algorithm._target_=no_such_module.SAC",
    "wrappers=[{a: 1}]",
    "n_epochs",
    "n_epochs=[",
]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _run(argument: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    arguments = [argument, "mlflow=0"]
    if not argument.startswith(("env=", "env_kwargs")):
        arguments.append(TINY)
    if not argument.lstrip("+").startswith("algorithm="):
        arguments.append("algorithm=sac")
    code = run_command_line(arguments)
    return code, capsys.readouterr().err.strip()


def test_typos_get_the_right_suggestion(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {}
    for typo, wanted in TYPOS:
        code, message = _run(typo, capsys)
        assert code == 2, (typo, message)
        if f"Did you mean '{wanted}'?" not in message:
            wrong[typo] = message
    assert len(wrong) <= len(TYPOS) // 10, wrong
    assert list(project.iterdir()) == [], "a refused command must leave nothing behind"


@pytest.mark.parametrize("argument", BAD_VALUES)
def test_bad_values_are_refused_in_one_line(
    argument: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, message = _run(argument, capsys)
    assert code == 2, message
    assert re.fullmatch(r"error: .+", message), message
    assert not [path for path in project.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("algorithm", "env", "reason"),
    [
        ("sac", "CartPole-v1", "needs Box actions, but CartPole-v1 has Discrete actions"),
        ("dqn", "Pendulum-v1", "needs Discrete actions, but Pendulum-v1 has Box actions"),
        ("crossq", "scilab_rl.testing:TinyReach-v0", "add +flatten_obs=1"),
    ],
)
def test_pairs_that_cannot_work_name_those_that_can(
    algorithm: str, env: str, reason: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_command_line([f"algorithm={algorithm}", f"env={env}", "mlflow=0"])
    message = capsys.readouterr().err
    assert code == 2
    assert reason in message
    if "needs" in reason:
        assert re.search(r"These can: .*ppo", message)
    assert not [path for path in project.rglob("*") if path.is_file()]


def test_hindsight_replay_needs_goals(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_command_line(
        ["algorithm=sac", "env=Pendulum-v1", "algorithm.replay_buffer_class=her", "mlflow=0"]
    )
    assert code == 2
    assert "++algorithm.replay_buffer_class=null" in capsys.readouterr().err


def test_desk_file_that_hides_behind_a_shipped_one(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / "conf" / "algorithm").mkdir(parents=True)
    (project / "conf" / "algorithm" / "sac.yaml").write_text("name: sac\n")
    assert run_command_line([TINY]) == 2
    assert "my_sac.yaml" in capsys.readouterr().err


def test_broken_yaml_names_file_and_line(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "conf" / "algorithm").mkdir(parents=True)
    (project / "conf" / "algorithm" / "mine.yaml").write_text("name: mine\n_target_: [\nx: 1\n")
    assert run_command_line([TINY, "algorithm=mine"]) == 2
    assert re.search(r"mine\.yaml:\d+", capsys.readouterr().err)


def test_traceback_only_with_debug(tmp_path: Path) -> None:
    plain = scilab_rl("algorithm=sacc", cwd=tmp_path)
    assert plain.returncode == 2
    assert "Traceback" not in plain.stderr
    debugged = scilab_rl("algorithm=sacc", "--debug", cwd=tmp_path)
    assert debugged.returncode == 2
    assert "Traceback" in debugged.stderr


def test_shows_configuration_and_version(tmp_path: Path) -> None:
    shown = scilab_rl("--cfg", "job", "n_epochs=17", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert "n_epochs: 17" in shown.stdout
    assert scilab_rl("--version", cwd=tmp_path).stdout.startswith("scilab-rl 1.")


# Kinds of mistakes about which Hydra would say something of its own, and what we say.
HYDRAS = {
    "algorithm._target_=custom_algorithms.foo.Bar": "custom_algorithms.foo.Bar' cannot be",
    "algorithm._target_=Bar": "must be like package.module.Class",
    "wrappers=[{_target_: foo.Bar}]": "wrappers._target_: 'foo.Bar' cannot be imported",
    "tracking.console._target_=foo.Bar": "tracking.console._target_: 'foo.Bar' cannot be imported",
    "++tracking.console.x=1": "tracking.console: TypeError",
    "+tracking.foo=1": "tracking.foo needs a _target_",
    "algorithm.action_noise._target_=foo.Bar": "algorithm.action_noise._target_: 'foo.Bar'",
    "algorithm.policy_kwargs.activation_fn=torch.nn.Tan": "Did you mean 'Tanh'",
    "algorithm.replay_buffer_class=foo.Bar": "algorithm.replay_buffer_class: 'foo.Bar'",
    "env_kwargs={nothing: {_target_: foo.Bar}}": "takes no env_kwargs.nothing",
    "info=${nothing}": "Interpolation key 'nothing' not found",
    "n_epochs=1,2": "add --multirun",
    "hydra/launcher=foo": "Did you mean 'launcher/local'",
    "--cfg=foo": "choose from",
    "--config-name=foo": "no configuration 'foo'",
    "--config-dir=foo": "not found",
}


def test_hydra_says_nothing_of_its_own(tmp_path: Path) -> None:
    """In a process of its own: pytest catches what libraries log."""
    code = (
        "import sys\nfrom scilab_rl.cli.main import run_command_line\n"
        f"for argument in {list(HYDRAS)!r}:\n"
        f"    code = run_command_line(['algorithm=sac', {TINY!r}, 'mlflow=0', argument])\n"
        "    print('exit code', code, file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=quiet_environment(), text=True,
        capture_output=True, check=False, timeout=120,
    )  # fmt: skip
    lines = done.stderr.splitlines()
    assert lines[1::2] == ["exit code 2"] * len(HYDRAS), done.stderr
    for line, (argument, expected) in zip(lines[::2], HYDRAS.items(), strict=True):
        assert line.startswith("error: ") and expected in line, (argument, line)
    assert "HYDRA_FULL_ERROR" not in done.stderr and "hydra.cc" not in done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_interpolations_of_the_command_line_are_of_the_configuration(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["algorithm=random", TINY, *QUICK[:3], "n_epochs=1", "seed=7", "mlflow=0"]
    assert run_command_line([*words, "info=seed ${seed}"]) == 0
    assert config_of(last_run(project))["info"] == "seed 7"


def test_a_finished_run_names_the_ways_to_train_on(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["algorithm=sac", TINY, *QUICK, "n_epochs=1", "require_updates=false"]
    assert run_command_line(words) == 0
    capsys.readouterr()
    assert run_command_line(["resume", "last", "n_epochs=2"]) == 1
    told = re.search(r"in a new run: scilab-rl (.*) \(and what else", capsys.readouterr().err)
    assert told
    again = [*told[1].split(), *QUICK, "n_epochs=1", "require_updates=false"]
    assert run_command_line(again) == 0
    assert "Policy restored from" in capsys.readouterr().err
    # One with a checkpoint goes on itself, and says so when nothing is left.
    words = ["algorithm=ppo", TINY, "algorithm.n_steps=50", *QUICK[1:3], "mlflow=0", "seed=1"]
    assert run_command_line([*words, "n_epochs=2", "save_model_freq=50"]) == 0
    capsys.readouterr()
    assert run_command_line(["resume", "last", "n_epochs=1"]) == 2
    told = re.search(r"To continue training: scilab-rl (.*)", capsys.readouterr().err)
    assert told
    assert run_command_line(told[1].split()) == 0
    assert config_of(last_run(project))["n_epochs"] == 4


def test_values_that_stable_baselines3_documents(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They train, and are data of the run that is played, exported and resumed bit for bit."""
    words = [
        "algorithm=sac", TINY, *QUICK, "n_epochs=2", "save_model_freq=130",
        "++algorithm.train_freq=(1,'episode')", "algorithm.learning_rate=lin_1e-3",
        "algorithm.policy_kwargs.activation_fn=torch.nn.Tanh",
        "algorithm.policy_kwargs.optimizer_class=torch.optim.AdamW",
        "algorithm.policy_kwargs.net_arch={pi: [8], qf: [16]}",
        "algorithm.replay_buffer_class=stable_baselines3.common.buffers.DictReplayBuffer",
    ]  # fmt: skip
    assert run_command_line(words) == 0, capsys.readouterr().err
    run = last_run(project)
    before = untimed_rows(run), (run / "rl_model_finished/tensors.safetensors").read_bytes()
    assert run_command_line(["resume", "last"]) == 0, capsys.readouterr().err
    after = untimed_rows(run), (run / "rl_model_finished/tensors.safetensors").read_bytes()
    assert after == before
    assert run_command_line(["play", "last", "--episodes", "1"]) == 0
    assert run_command_line(["export", "last", "--episodes", "1"]) == 0
