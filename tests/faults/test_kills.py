"""Processes that are killed or asked to stop: what was learned survives, bit for bit."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from scilab_rl.training import checkpoint
from scilab_rl.training.interruption import graceful_shutdown

from ..e2e.commands import ROOT, command, quiet_environment
from .harness import ENV, Process, content, last_run, result_of, runs_in, scilab_rl, wait_until

SHORT = (
    ENV, "n_epochs=3", "eval_after_n_steps=40", "n_test_rollouts=1", "seed=7", "mlflow=0",
    "tuned=false", "save_model_freq=30",
)  # fmt: skip
DISCRETE = ("env=scilab_rl.testing:TinyReachDiscrete-v0", *SHORT[1:])
_OFF_POLICY = ("algorithm.buffer_size=500", "algorithm.batch_size=8", "algorithm.net_arch=[8]")
ALGORITHMS = {
    "cleansac": ("algorithm=cleansac", *SHORT, *_OFF_POLICY),
    "cleansacmc": ("algorithm=cleansacmc", *SHORT, *_OFF_POLICY),
    "sac": (
        "algorithm=sac", *SHORT, *_OFF_POLICY[:2], "algorithm.policy_kwargs={net_arch: [8]}",
    ),
    "td3": (
        "algorithm=td3", *SHORT, *_OFF_POLICY[:2], "algorithm.policy_kwargs={net_arch: [8]}",
    ),
    # Noise of Stable-Baselines3 that has a memory of its own.
    "sac with gSDE": (
        "algorithm=sac", *SHORT, *_OFF_POLICY[:2], "algorithm.policy_kwargs={net_arch: [8]}",
        "algorithm.use_sde=true",
    ),
    "ddpg with correlated noise": (
        "algorithm=ddpg", *SHORT, *_OFF_POLICY[:2], "algorithm.policy_kwargs={net_arch: [8]}",
        "algorithm.action_noise._target_="
        "stable_baselines3.common.noise.OrnsteinUhlenbeckActionNoise", "n_envs=2",
    ),
    "ppo with gSDE": (
        "algorithm=ppo", *SHORT, "algorithm.n_steps=20", "algorithm.batch_size=10",
        "algorithm.use_sde=true",
    ),
    "cleanppo": ("algorithm=cleanppo", *SHORT, "algorithm.n_steps=20", "algorithm.batch_size=10"),
    "ppo": ("algorithm=ppo", *SHORT, "algorithm.n_steps=20", "algorithm.batch_size=10"),
    "onestepac": ("algorithm=onestepac", *DISCRETE),
    "random": ("algorithm=random", *SHORT),
    "cleandqn": ("algorithm=cleandqn", *DISCRETE, *_OFF_POLICY),
    "actor_critic": ("algorithm=actor_critic", *SHORT, "+flatten_obs=1"),
}  # fmt: skip
# Each place where a checkpoint or a metric is written, and at which passing the process is killed:
# in the first generation, and in a later one.
IN_CHECKPOINTS = (
    "checkpoint.begin", "checkpoint.after_tensors", "checkpoint.in_arrays",
    "checkpoint.before_manifest", "checkpoint.before_swap", "checkpoint.in_swap",
    "checkpoint.before_link", "checkpoint.before_forgetting",
)  # fmt: skip
IN_METRICS = (
    "metrics.before_line",
    "metrics.after_line",
    "metrics.after_row",
    "file.before_replace",
)
POINTS = [f"{name}:{count}:SIGKILL" for name in (*IN_CHECKPOINTS, *IN_METRICS) for count in (2, 3)]
POINTS.append("file.before_replace:9:SIGKILL")  # the first three come before a run is one
POINTS.append("files.in_discarding:1:SIGKILL")  # of the oldest generation; so short a run has few


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory):
    """Return a function that gives the content of an algorithm's uninterrupted run."""
    contents = {}

    def run(algorithm: str):
        if algorithm not in contents:
            folder = tmp_path_factory.mktemp(algorithm)
            done = scilab_rl(*ALGORITHMS[algorithm], cwd=folder)
            assert done.code == 0, done.errors
            contents[algorithm] = content(last_run(folder))
        return contents[algorithm]

    return run


def finish(algorithm: str, folder: Path) -> Path:
    """Resume the run, or start anew where it was killed before there was a whole checkpoint."""
    if not (runs := runs_in(folder)):  # killed before it was one
        done = scilab_rl("clean", "--yes", cwd=folder)
        assert "run without any result" in done.output, done.errors
        assert not list(folder.glob("data/*/*/*"))
    else:
        (run,) = runs
        done = scilab_rl("resume", str(run), cwd=folder)
        if done.code == 0:
            return run
        assert "no checkpoint" in done.error, done.errors
        shutil.rmtree(run)
    assert scilab_rl(*ALGORITHMS[algorithm], cwd=folder).code == 0
    (run,) = runs_in(folder)
    return run


def check_whole(run: Path) -> None:
    """Check that each file is whole and that nothing unfinished is left."""
    for directory in run.glob("checkpoints/step_*"):
        checkpoint.verify(directory)
    for line in (run / "metrics.jsonl").read_text().splitlines():
        json.loads(line)
    assert not [path for path in run.rglob(".*.tmp")]
    assert not [path for path in run.rglob("*.old")]
    assert len(list(run.glob("checkpoints/step_*"))) <= 2


@pytest.mark.parametrize("point", [*POINTS[3::5], POINTS[-1]])
def test_f02_killed_while_writing(point: str, uninterrupted, tmp_path: Path) -> None:
    kill_at(point, uninterrupted, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_f02_killed_at_each_place(point: str, uninterrupted, tmp_path: Path) -> None:
    kill_at(point, uninterrupted, tmp_path)


def kill_at(point: str, uninterrupted, folder: Path) -> None:
    expected = uninterrupted("cleansac")
    killed = scilab_rl(*ALGORITHMS["cleansac"], cwd=folder, fault=point)
    assert killed.code == -signal.SIGKILL, killed.errors
    run = finish("cleansac", folder)
    assert content(run) == expected
    check_whole(run)


@pytest.mark.parametrize("algorithm", ["cleanppo", "sac with gSDE"])
def test_f01_killed_and_resumed_is_as_uninterrupted(
    algorithm: str, uninterrupted, tmp_path: Path
) -> None:
    killed_again_and_again(algorithm, uninterrupted, tmp_path, n_kills=2)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_f01_each_algorithm_killed_again_and_again(
    algorithm: str, uninterrupted, tmp_path: Path
) -> None:
    killed_again_and_again(algorithm, uninterrupted, tmp_path, n_kills=10)


def killed_again_and_again(algorithm: str, uninterrupted, folder: Path, n_kills: int) -> None:
    """Kill at random steps and resume; the rest is done in peace. Progress never goes back far."""
    expected = uninterrupted(algorithm)
    rng = random.Random(algorithm)
    process = Process(ALGORITHMS[algorithm], folder)
    steps = []
    for _ in range(n_kills):
        wait_until(lambda: list(folder.glob("data/*/*/checkpoints/last/manifest.json")))
        deadline = time.monotonic() + rng.uniform(0.0, 0.3)
        while process.is_running() and time.monotonic() < deadline:
            time.sleep(0.002)
        if process.is_running():
            process.signal(signal.SIGKILL)
        if process.wait().code == 0:
            break
        (run,) = runs_in(folder)
        steps.append(checkpoint.verify(run / "checkpoints" / "last")["step"])
        process = Process(("resume", str(run)), folder)
    else:
        process.wait()
    assert steps == sorted(steps)
    (run,) = runs_in(folder)
    if result_of(run)["status"] != "finished":
        assert scilab_rl("resume", str(run), cwd=folder).code == 0
    assert content(run) == expected
    check_whole(run)


def long_run(folder: Path, *more: str, **options: Any) -> Process:
    """Start a run of many steps, and wait until it learns."""
    endless = ("algorithm=random", ENV, "n_epochs=100000", *SHORT[2:], *more)
    process = Process(endless, folder, **options)
    wait_until(lambda: list(folder.glob("data/*/*/metrics.csv")))
    return process


@pytest.mark.parametrize(
    ("number", "variables", "code"),
    [
        (signal.SIGTERM, {}, 143),
        (signal.SIGTERM, {"SLURM_JOB_ID": "1"}, 75),
        (signal.SIGINT, {}, 130),
    ],
)
def test_f03_asked_to_stop(
    number: signal.Signals, variables: dict[str, str], code: int, tmp_path: Path
) -> None:
    process = long_run(tmp_path, variables=variables)
    asked = time.monotonic()
    process.signal(number)
    done = process.wait(30)
    assert time.monotonic() - asked < 10
    assert done.code == code, done.errors
    run = last_run(tmp_path)
    assert f"Resume with: scilab-rl resume {run.relative_to(tmp_path)}" in done.errors
    assert "Traceback" not in done.errors
    assert result_of(run)["status"] == "interrupted"
    checkpoint.verify(run / "checkpoints" / "last")


def test_f03_asked_twice_it_ends_at_once(tmp_path: Path) -> None:
    """The first signal is noted at the end of a step, and this step never ends."""
    process = Process(
        ("algorithm=random", *SHORT, "env_kwargs.fault=hang", "env_kwargs.at=100"), tmp_path
    )
    wait_until(lambda: list(tmp_path.glob("data/*/*/metrics.csv")))
    time.sleep(1)
    process.signal(signal.SIGTERM)
    time.sleep(0.5)
    assert process.is_running()
    process.signal(signal.SIGTERM)
    assert process.wait(5).code == 143


def test_f03_handlers_are_given_back_and_only_the_main_thread_has_any() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with graceful_shutdown() as request:
        assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] != before
        os.kill(os.getpid(), signal.SIGTERM)
        assert request.signal_number == signal.SIGTERM
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before

    seen = []

    def elsewhere() -> None:
        with graceful_shutdown():
            seen.append([signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)])

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [before]


def test_f04_ctrl_c_reaches_all_processes_and_leaves_none(tmp_path: Path) -> None:
    """A terminal sends it to the whole group, so to the environments' processes too."""
    endless = ("algorithm=random", ENV, "n_epochs=100000", *SHORT[2:])
    process = subprocess.Popen(
        command(*endless, "n_envs=2", "vector=subprocess"), cwd=tmp_path, text=True,
        env=quiet_environment(PYTHONPATH=str(ROOT)), stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    wait_until(lambda: list(tmp_path.glob("data/*/*/metrics.csv")))
    assert len(members(process.pid)) >= 3
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130, errors
    assert "Resume with" in errors
    assert "Traceback" not in errors
    wait_until(lambda: members(process.pid) == [], 10)


def members(group: int) -> list[int]:
    """Return the living processes of a group."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, their_group = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(their_group) == group and state != "Z":
            found.append(int(stat.parent.name))
    return found
