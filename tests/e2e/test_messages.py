"""Wrong input: one line with what to do, exit code 2, and nothing left behind."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scilab_rl.cli import run_command_line

from .commands import TINY, scilab_rl

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
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
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


def test_typos_get_the_right_suggestion(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = {}
    for typo, wanted in TYPOS:
        code, message = _run(typo, capsys)
        assert code == 2, (typo, message)
        if f"Did you mean '{wanted}'?" not in message:
            wrong[typo] = message
    assert len(wrong) <= len(TYPOS) // 10, wrong
    assert list(desk.iterdir()) == [], "a refused command must leave nothing behind"


@pytest.mark.parametrize("argument", BAD_VALUES)
def test_bad_values_are_refused_in_one_line(
    argument: str, desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, message = _run(argument, capsys)
    assert code == 2, message
    assert re.fullmatch(r"error: .+", message), message
    assert not [path for path in desk.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("algorithm", "env", "reason"),
    [
        ("sac", "CartPole-v1", "needs Box actions, but CartPole-v1 has Discrete actions"),
        ("dqn", "Pendulum-v1", "needs Discrete actions, but Pendulum-v1 has Box actions"),
        ("crossq", "scilab_rl.testing:TinyReach-v0", "add +flatten_obs=1"),
    ],
)
def test_pairs_that_cannot_work_name_those_that_can(
    algorithm: str, env: str, reason: str, desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_command_line([f"algorithm={algorithm}", f"env={env}", "mlflow=0"])
    message = capsys.readouterr().err
    assert code == 2
    assert reason in message
    if "needs" in reason:
        assert re.search(r"These can: .*ppo", message)
    assert not [path for path in desk.rglob("*") if path.is_file()]


def test_hindsight_replay_needs_goals(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_command_line(
        ["algorithm=sac", "env=Pendulum-v1", "algorithm.replay_buffer_class=her", "mlflow=0"]
    )
    assert code == 2
    assert "++algorithm.replay_buffer_class=null" in capsys.readouterr().err


def test_desk_file_that_hides_behind_a_shipped_one(
    desk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (desk / "conf" / "algorithm").mkdir(parents=True)
    (desk / "conf" / "algorithm" / "sac.yaml").write_text("name: sac\n")
    assert run_command_line([TINY]) == 2
    assert "my_sac.yaml" in capsys.readouterr().err


def test_broken_yaml_names_file_and_line(desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (desk / "conf" / "algorithm").mkdir(parents=True)
    (desk / "conf" / "algorithm" / "mine.yaml").write_text("name: mine\n_target_: [\nx: 1\n")
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
