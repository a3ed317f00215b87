"""Environments that raise, hang, die, or return what they must not."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.run_env import END_EPISODE, IGNORE, STOP, RunEnv
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.errors import EnvironmentFailure, NumericalError
from scilab_rl.training import resume
from scilab_rl.training.watchdog import watchdog

from .environment import ID
from .harness import CLEANSAC, RANDOM, last_run, result_of, scilab_rl

ENTRIES = ("observation", "achieved_goal", "desired_goal")
NUMBERS = [
    (fault, place, in_reset)
    for fault in ("nan", "inf")
    for place in (*ENTRIES, "reward")
    for in_reset in (False, True)
    if not (place == "reward" and in_reset)
]
# fault, place, and what the message says about it
BROKEN = [
    *[(fault, place, f"observation '{place}' {what}")
      for place in ENTRIES
      for fault, what in [
          ("short", r"has shape \(1,\), but its space has \(2,\)"),
          ("long", r"has shape \(4,\), but its space has \(2,\)"),
          ("text", r"is of type <U1, but its space of float32"),
          ("none", r"has shape \(\), but its space has \(2,\)"),
          ("number", r"has shape \(\), but its space has \(2,\)"),
      ]],
    *[("missing", place, f"the observation has no '{place}'") for place in ENTRIES],
    ("number", "whole", "the observation is of type float and not a dictionary"),
    ("none", "whole", "the observation is of type NoneType and not a dictionary"),
    ("none", "reward", "the reward is None and not a number"),
    ("words", "reward", "the reward is 'yes' and not a number"),
    ("none", "terminated", "terminated is None and not True or False"),
    ("number", "terminated", "terminated is 0.5 and not True or False"),
    ("words", "truncated", "truncated is 'yes' and not True or False"),
    ("none", "info", "the info is None and not a dictionary"),
]  # fmt: skip


def switched(**switches: Any) -> tuple[str, ...]:
    return tuple(f"env_kwargs.{name}={value}" for name, value in switches.items())


def act(n_steps: int = 20, *, on_nan: str = STOP, vector: str = "inprocess", **switches: Any):
    """Step the environment with observers, and return what they saw."""
    cfg = RunConfig(ID, switches, n_envs=2, seed=3, on_nan=on_nan, vector=vector)
    env = make_train_env(cfg)
    seen: list[Any] = []
    env.observers.append(type("Observer", (), {"on_step": lambda self, step: seen.append(step)})())
    try:
        env.reset()
        for _ in range(n_steps):
            env.step(np.full((2, 2), 0.5, np.float32))
    finally:
        env.close()
    return seen


@pytest.mark.parametrize(("fault", "place", "in_reset"), NUMBERS)
def test_f10_no_number(fault: str, place: str, in_reset: bool) -> None:
    at = 2 if in_reset else 5
    what = "reward" if place == "reward" else f"observation '{place}'"
    index = "()" if place == "reward" else "(1,)"
    message = rf"Faulty-v0: {what} is {fault} at index {re.escape(index)} of environment 0 after "
    with pytest.raises(EnvironmentFailure, match=message) as error:
        act(fault=fault, place=place, at=at, in_reset=in_reset)
    assert "last action [0.5 0.5]" in str(error.value)


@pytest.mark.parametrize(("fault", "place", "message"), BROKEN)
@pytest.mark.parametrize("in_reset", [False, True])
def test_f10_broken_contract(fault: str, place: str, message: str, in_reset: bool) -> None:
    if in_reset and place in ("reward", "terminated", "truncated", "info"):
        return
    with pytest.raises(EnvironmentFailure, match=message) as error:
        act(fault=fault, place=place, at=2 if in_reset else 5, in_reset=in_reset)
    text = str(error.value)
    assert re.search(r"Faulty-v0 broke its contract in step\(\) at train step \d+ \(seed 3\)", text)
    assert in_reset or "; last action [0.5 0.5]" in text
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize("place", [*ENTRIES, "reward"])
def test_f10_an_episode_can_end_there_instead(place: str) -> None:
    seen = act(fault="nan", place=place, at=5, on_nan=END_EPISODE)
    spoiled = seen[4]
    assert spoiled.dones.all()
    assert all(info["simulation_unstable"] for info in spoiled.infos)
    for step in seen:
        assert np.isfinite(step.rewards).all()
        assert all(np.isfinite(step.observations[key]).all() for key in ENTRIES)
        assert all(np.isfinite(step.next_observations[key]).all() for key in ENTRIES)


def test_f10_and_it_can_be_ignored() -> None:
    seen = act(fault="nan", place="observation", at=5, on_nan=IGNORE)
    assert len(seen) == 20
    assert np.isnan(seen[4].next_observations["observation"][0, 1])


def test_f10_out_of_bounds_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    env = make_train_env(
        RunConfig(ID, {"fault": "outside", "place": "achieved_goal", "at": 3}, seed=1)
    )
    env.reset()
    for _ in range(40):
        env.step(np.zeros((1, 2), np.float32))
    (message,) = [r.getMessage() for r in caplog.records if "bounds" in r.getMessage()]
    assert re.search(r"observation 'achieved_goal' is 1[01].* at index \(0,\), outside", message)


def test_f10_goals_without_success_are_told(caplog: pytest.LogCaptureFixture) -> None:
    from .environment import Faulty

    class Silent(Faulty):
        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, _ = super().step(action)
            return observation, reward, terminated, truncated, {}

    env = DummyVecEnv([lambda: RunEnv(Silent())])
    env.reset()
    for _ in range(3):
        env.step(np.zeros((1, 2), np.float32))
    assert caplog.text.count("no 'is_success'") == 1


def test_f10_nothing_of_it_reaches_the_replay_buffer(tmp_path: Path) -> None:
    fault = switched(fault="nan", place="achieved_goal", at=150)
    done = scilab_rl(*CLEANSAC, *fault, cwd=tmp_path)
    assert done.code == 1
    assert re.fullmatch(
        rf"error: {re.escape(ID)}: observation 'achieved_goal' is nan at index \(1,\) of "
        r"environment 0 after step 149; last action \[.+\]\.", done.error,
    )  # fmt: skip
    snapshot, step = resume.load_latest(last_run(tmp_path))
    assert step == 149
    for name, array in snapshot.arrays.items():
        assert array.dtype.kind != "f" or np.isfinite(array).all(), name


@pytest.mark.parametrize(
    ("place", "at", "message"),
    [
        ("init", 1, "cannot be made: ValueError: the gripper broke and fell"),
        ("reset", 1, r"raised ValueError in reset() at train step 0 (seed 7): the gripper broke"),
        ("reset", 5, r"raised ValueError in step() at train step 59 (seed 7): the gripper broke"),
        ("step", 1, r"raised ValueError in step() at train step 0 (seed 7): the gripper broke"),
        ("step", 150, r"raised ValueError in step() at train step 149 (seed 7): the gripper broke"),
    ],
)
def test_f09_environment_raises(place: str, at: int, message: str, tmp_path: Path) -> None:
    done = scilab_rl(*RANDOM, *switched(fault="raise", place=place, at=at), cwd=tmp_path)
    assert done.code == 1
    assert done.error.startswith(f"error: {ID} {message}")
    assert "Traceback" not in done.errors
    if place != "init":
        assert result_of(last_run(tmp_path))["status"] == "failed"
        assert "the gripper broke" in (last_run(tmp_path) / "error.log").read_text()


@pytest.mark.parametrize(("place", "at"), [("close", 1), ("render", 1), ("render", 3)])
def test_f09_what_is_not_learning_stops_nothing(place: str, at: int, tmp_path: Path) -> None:
    fault = switched(fault="raise", place=place, at=at)
    show = ("render=record", "render_freq=1", "n_epochs=1") if place == "render" else ()
    done = scilab_rl(*RANDOM, *fault, *show, cwd=tmp_path)
    assert done.code == 0, done.errors
    assert "the gripper broke" in done.errors
    assert result_of(last_run(tmp_path))["status"] == "finished"


def test_f09_what_was_learned_until_then_goes_on(tmp_path: Path) -> None:
    fault = switched(fault="raise", at=150, once=tmp_path / "happened")
    done = scilab_rl(*CLEANSAC, *fault, cwd=tmp_path)
    assert done.code == 1
    assert "What was learned until step 149 is kept. Continue with: scilab-rl resume" in done.errors
    resumed = scilab_rl("resume", "last", cwd=tmp_path)
    assert resumed.code == 0, resumed.errors
    result = result_of(last_run(tmp_path))
    assert (result["status"], result["epochs"], result["steps"]) == ("finished", 3, 300)


def test_f09_in_a_process_of_its_own() -> None:
    with pytest.raises(EnvironmentFailure, match=r"ValueError in step\(\).*: the gripper broke"):
        act(fault="raise", at=4, vector="subprocess")
    with pytest.raises(EnvironmentFailure, match=r"broke its contract in step\(\).*has no 'ach"):
        act(fault="missing", place="achieved_goal", at=4, vector="subprocess")


@pytest.mark.parametrize("vector", ["subprocess", "workers"])
def test_f14_dead_worker_is_one_line_and_no_deadlock(vector: str) -> None:
    started = time.monotonic()
    message = r"its worker process \d ended with exit code -9, maybe out of memory"
    with pytest.raises(EnvironmentFailure, match=message):
        act(fault="kill", at=4, vector=vector)
    assert time.monotonic() - started < 60  # most of it is starting the workers
    assert not living_children()


def test_f14_run_whose_worker_dies_ends_with_exit_code_1(tmp_path: Path) -> None:
    fault = switched(fault="kill", at=40)
    done = scilab_rl(*RANDOM, *fault, "n_envs=2", "vector=subprocess", cwd=tmp_path)
    assert done.code == 1, done.errors
    assert "ended with exit code -9, maybe out of memory" in done.error


def living_children() -> list[str]:
    """Return the commands of this process's children that are environments."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    commands = [Path(f"/proc/{pid}/cmdline").read_text() for pid in children]
    return [c for c in commands if "spawn_main" in c]


def test_f13_hanging_environment_is_told_with_what_it_does(tmp_path: Path) -> None:
    """Studies end such a run after ``trial_timeout``: see the tests of studies."""
    fault = switched(fault="hang", at=150, once=tmp_path / "happened")
    done = scilab_rl(*RANDOM, *fault, "warn_after_seconds=1", cwd=tmp_path)
    assert done.code == 0, done.errors
    assert done.errors.count("No step for 1 s: does the environment hang?") == 1
    assert "in _happens" in (last_run(tmp_path) / "stack.txt").read_text()


def test_f13_silent_while_all_is_well(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    count = iter(range(1000))
    with watchdog(lambda: next(count), 0.1, tmp_path / "stack.txt"):
        time.sleep(0.5)
    assert caplog.text == ""
    assert not (tmp_path / "stack.txt").exists()
    with watchdog(lambda: 0, 0.1, tmp_path / "stack.txt"):
        time.sleep(0.5)
    assert caplog.text.count("No step for 0.1 s") == 1
    assert "What it is doing is in" in caplog.text


def test_f13_without_a_place_for_the_stack(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with watchdog(lambda: 0, 0.1, tmp_path / "missing" / "stack.txt"):
        time.sleep(0.5)
    assert "No step for 0.1 s" in caplog.text and "cannot be written" in caplog.text


def test_f13_stack_is_written_while_a_simulator_holds_the_interpreter(tmp_path: Path) -> None:
    """No Python thread runs from the call on, until the alarm kills the process."""
    script = (
        "import ctypes, signal, sys; from pathlib import Path\n"
        "from scilab_rl.training.watchdog import watchdog\n"
        "def simulator(): ctypes.PyDLL(None).usleep(900_000)\n"
        "with watchdog(lambda: 0, 0.2, Path(sys.argv[1])):\n"
        "    signal.setitimer(signal.ITIMER_REAL, 0.7)\n"
        "    simulator()"
    )
    path = tmp_path / "stack.txt"
    done = subprocess.run([sys.executable, "-c", script, str(path)], check=False)
    assert done.returncode == -signal.SIGALRM
    assert "in simulator" in path.read_text()


@pytest.mark.parametrize(
    ("algorithm", "more"),
    [
        ("cleansac", CLEANSAC[1:]),
        ("sac", CLEANSAC[1:-1]),
        ("cleanppo", (*RANDOM[1:], "algorithm.n_steps=32", "algorithm.batch_size=16")),
    ],
)
def test_f12_no_number_in_the_weights_ends_the_run(
    algorithm: str, more: tuple[str, ...], tmp_path: Path
) -> None:
    done = scilab_rl(f"algorithm={algorithm}", *more, "algorithm.learning_rate=1e30", cwd=tmp_path)
    assert done.code == 1, done.errors
    assert "not finite" in done.error or re.search(r"is (nan|inf)", done.error)
    assert "learning rate" in done.error
    result = result_of(last_run(tmp_path))
    assert (result["status"], result["score"]) == ("failed", None)


def test_f12_one_poisoned_weight_is_found() -> None:
    import torch

    from scilab_rl.training.loop import refuse_nan

    policy = torch.nn.Linear(2, 2)
    model = SimpleNamespace(policy=policy, learning_rate=0.1, gamma=0.9, num_timesteps=310)
    refuse_nan(model, {"train/critic_loss": 1.0})
    with pytest.raises(NumericalError, match=r"train/critic_loss is nan after 310 steps \(learning_"
                                             r"rate=0.1, gamma=0.9\)"):  # fmt: skip
        refuse_nan(model, {"train/critic_loss": float("nan")})
    with torch.no_grad():
        policy.weight[1, 0] = float("inf")
    with pytest.raises(NumericalError, match="weight weight is nan after 310 steps"):
        refuse_nan(model, {"train/critic_loss": 1.0})
