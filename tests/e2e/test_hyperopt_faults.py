"""What goes wrong on the machine while a study trains, with real trainings."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest

from .commands import command, quiet_environment, untimed_rows
from .test_hyperopt import TINY_RUNS, runs_of, study_of

GIB = 2**30
LONG_RUN = (
    *TINY_RUNS, "n_epochs=6", "eval_after_n_steps=100", "save_model_freq=100",
    "algorithm.learning_starts=50", "algorithm.batch_size=16", "early_stop_threshold=2",
    "algorithm.gamma=0.9,0.95", "--multirun", "hydra.sweeper.n_jobs=1",
    "hydra.sweeper.max_trials=2",
    "hydra.sweeper.min_trials_per_param=1", "hydra.sweeper.max_trials_per_param=1",
    "hydra.sweeper.n_final_runs=0", "hydra.sweeper.seed=3", "hydra.sweeper.study_name=one",
)  # fmt: skip


def start(*arguments: str, cwd: Path, memory_bytes: int = 0) -> subprocess.Popen:
    def limit_memory() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))

    return subprocess.Popen(
        command(*arguments), cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=quiet_environment(), preexec_fn=limit_memory if memory_bytes else None,
    )  # fmt: skip


def end_of(process: subprocess.Popen, code: int) -> tuple[str, str]:
    output, errors = process.communicate(timeout=240)
    assert process.returncode == code, errors
    return output, errors


def kill_after_a_checkpoint(process: subprocess.Popen, folder: Path) -> None:
    """Kill the worker of a study as soon as its run has a checkpoint."""
    deadline = time.monotonic() + 120
    while not list(folder.glob("data/*/*/checkpoints/last")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    (run,) = (path for path in folder.glob("data/*/*/.lock"))
    workers = psutil.Process(process.pid).children(recursive=True)
    (worker,) = (
        w for w in workers if str(run) in {Path(f.path).as_posix() for f in w.open_files()}
    )
    os.kill(worker.pid, signal.SIGKILL)


@pytest.mark.slow
def test_f15_killed_worker_s_run_continues_from_its_checkpoint(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    end_of(start(*LONG_RUN, cwd=whole), 0)
    process = start(*LONG_RUN, cwd=killed)
    kill_after_a_checkpoint(process, killed)
    _, errors = end_of(process, 0)
    assert "killed by SIGKILL" in errors
    expected, found = runs_of(study_of(whole, "one")), runs_of(study_of(killed, "one"))
    assert [run.attempt for run in found] == [1, 0]
    assert [(run.seed, run.values, run.scores) for run in found] == [
        (run.seed, run.values, run.scores) for run in expected
    ]
    first = [folder / runs[0].run_dir for folder, runs in ((whole, expected), (killed, found))]
    assert untimed_rows(first[0]) == untimed_rows(first[1])
    assert len(list(killed.glob("data/*-*-*/*/result.json"))) == 2, "the same folder went on"


@pytest.mark.slow
def test_f15_run_out_of_memory_fails_and_the_others_go_on(tmp_path: Path) -> None:
    process = start(
        *TINY_RUNS, "algorithm.buffer_size=1000,1000000000", "--multirun",
        "hydra.sweeper.max_trials=4", "hydra.sweeper.min_trials_per_param=2",
        "hydra.sweeper.max_retries=1", "hydra.sweeper.study_name=large", cwd=tmp_path,
        memory_bytes=24 * GIB,
    )  # fmt: skip
    output, errors = end_of(process, 3)
    assert "Traceback" not in errors
    assert "buffer_size=1000\n" in output
    failed = [run for run in runs_of(study_of(tmp_path, "large")) if run.state == "failed"]
    assert failed
    assert all("allocate" in run.error and run.attempt == 1 for run in failed)
