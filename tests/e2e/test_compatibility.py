"""The commands that the paper and its wiki print run word for word, only shortened."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from .commands import ROOT, config_of, last_run, scilab_rl

SHORT = (
    "n_epochs=1", "eval_after_n_steps=60", "n_test_rollouts=1", "mlflow=0", "require_updates=false",
    "++algorithm.buffer_size=1000", "++algorithm.batch_size=16", "tuned=false",
)  # fmt: skip

COMMANDS = [
    ("python src/main.py", "FetchReach-v4"),
    ("python src/main.py algorithm=sac env=FetchReach-v2", "FetchReach-v4"),
    ("python src/main.py env=FetchPush-v2", "FetchPush-v4"),
    ("python src/main.py algorithm=sac_var env=FetchPush-v1", "FetchPush-v4"),
    ("python src/main.py +env_kwargs.reward_type=dense", "FetchReach-v4"),
    ("python src/main.py ++n_epochs=3 ++algorithm.learning_rate=0.007", "FetchReach-v4"),
    (
        "python src/main.py early_stop_data_column=eval/mean_reward early_stop_threshold=-40 "
        "early_stop_last_n=1",
        "FetchReach-v4",
    ),
    (
        "python src/main.py algorithm=sac env=Pendulum-v1 +flatten_obs=1 +clip_action=1",
        "Pendulum-v1",
    ),
    (
        "python src/main.py algorithm=sac env=FetchReach-v4 +flatten_obs=1 +normalize_obs=1 "
        "+normalize_reward=1",
        "FetchReach-v4",
    ),
    (
        "python src/main.py env=Blocks-o0-gripper_random-v1 algorithm=cleansac wandb=0",
        "Blocks-o0-gripper_random-v1",
    ),
    ("python src/main.py env=Reach1DOF-v0 algorithm=cleansac wandb=0", "Reach1DOF-v0"),
    ("python src/main.py algorithm=actor_critic env=Reach1DOF-v0 +flatten_obs=1", "Reach1DOF-v0"),
    ("python src/main.py algorithm=ppo env=CartPole-v1 +time_aware_observation=1", "CartPole-v1"),
]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with the project folder of the repository, so that runs land elsewhere."""
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    (tmp_path / "src").symlink_to(ROOT / "src")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(("line", "env"), COMMANDS, ids=[line for line, _ in COMMANDS])
def test_command_runs_word_for_word(line: str, env: str, project: Path) -> None:
    arguments = shlex.split(line)[2:]
    given = {argument.lstrip("+").partition("=")[0] for argument in arguments}
    short = [key for key in SHORT if key.lstrip("+").partition("=")[0] not in given]
    if "algorithm=ppo" in arguments:
        short = [key for key in short if "buffer_size" not in key] + ["++algorithm.n_steps=32"]
    done = scilab_rl(*arguments, *short, cwd=project)
    assert done.returncode == 0, done.stderr
    run = last_run(project)
    assert config_of(run)["env"] == env
    assert json.loads((run / "result.json").read_text())["epochs"] >= 1


@pytest.mark.slow
def test_sweep_over_algorithms_goes_on_after_a_failure(project: Path) -> None:
    done = scilab_rl(
        "--multirun", "algorithm=sac,dqn,td3", "env=Pendulum-v1", *SHORT, cwd=project, timeout=300
    )
    assert done.returncode == 3  # the sweep has finished, and some runs failed
    assert "dqn needs Discrete actions" in done.stderr
    results = list(project.glob("data/*/*/result.json"))
    assert len(results) == 2
