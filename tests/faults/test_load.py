"""Much of everything: runs of a study under fire, runs at the same time, steps, values.

`benchmarks/load.py` does the same with whole trainings, for a machine that has nothing else to do.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.results import RunResult
from scilab_rl.run.directory import read_epochs
from scilab_rl.search.runs import COMPLETE, LOST, RUNNING
from scilab_rl.search.storage import StudyStorage
from scilab_rl.tracking.base import TrackedRun
from scilab_rl.tracking.files import FilesTracker

from .harness import RANDOM, last_run, result_of, scilab_rl

ROOT = Path(__file__).parents[2]
N_TRIALS = 200


@pytest.mark.slow
def test_f16_two_hundred_runs_while_workers_and_parents_are_killed(tmp_path: Path) -> None:
    """Real processes and storage, runs of a formula: killed some dozen times, none is lost."""
    study, rng, kills = tmp_path / "study", random.Random(0), Counter[str]()
    deadline = time.monotonic() + 900
    process = start(study)
    while process.poll() is None:
        assert time.monotonic() < deadline, (kills, n_done(study))
        wait_for_progress(process, study, rng.randint(3, 12))
        if process.poll() is not None:
            break
        workers = children(process.pid)
        if workers and rng.random() < 0.6:
            os.kill(rng.choice(workers), signal.SIGKILL)
            kills["worker"] += 1
        else:
            process.kill()
            process.communicate()
            kills["parent"] += 1
            process = start(study)
    output, errors = process.communicate()
    assert (process.returncode, output) == (0, "finished\n"), errors
    runs = StudyStorage(study).runs()
    searched = [run for run in runs if not run.is_final]
    assert len(searched) == N_TRIALS
    assert len({(run.trial, run.repeat) for run in runs}) == len(runs) == N_TRIALS + 1
    assert [run.number for run in runs] == list(range(N_TRIALS + 1))
    assert not [run for run in runs if run.state in (RUNNING, LOST)]
    assert sum(run.state == COMPLETE for run in runs) > N_TRIALS // 4  # the others were pruned
    assert kills["worker"] >= 5
    assert kills["parent"] >= 5
    sys.stderr.write(f"{dict(kills)} {Counter(run.state for run in runs)}\n")


def start(study: Path) -> subprocess.Popen:
    words = [sys.executable, "-m", "tests.unit.search.toy", str(study), str(N_TRIALS), "2", ""]
    return subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def n_done(study: Path) -> int:
    if not study.exists():
        return 0
    try:
        return sum(run.state != RUNNING for run in StudyStorage(study).runs())
    except Exception:  # noqa: BLE001 - the database is just being made
        return 0


def wait_for_progress(process: subprocess.Popen, study: Path, n_more: int) -> None:
    wanted = n_done(study) + n_more
    while process.poll() is None and n_done(study) < wanted:
        time.sleep(0.2)


def children(pid: int) -> list[int]:
    try:
        words = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return [
            int(word) for word in words if "spawn_main" in Path(f"/proc/{word}/cmdline").read_text()
        ]
    except OSError:
        return []


def test_ten_thousand_values_per_second(tmp_path: Path) -> None:
    """In processor time of this thread: what else the machine does, does not count."""
    logger = MetricLogger()
    started = time.thread_time()
    for index in range(20_000):
        logger.record("train/x", index)
    assert time.thread_time() - started < 2.0
    tracker = FilesTracker()
    tracker.begin(TrackedRun(RunConfig(), tmp_path))
    values = {f"train/{index}": index / 7 for index in range(50)}
    started = time.thread_time()
    for epoch in range(200):
        tracker.epoch(epoch, epoch, values)
    assert time.thread_time() - started < 1.0
    tracker.end(RunResult("finished", 0.0, 1, 1, 1.0, str(tmp_path)))
    rows = (tmp_path / "metrics.csv").read_text().splitlines()
    assert len(rows) == 201
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 200


@pytest.mark.slow
def test_files_grow_by_a_line_per_episode_and_a_row_per_epoch(tmp_path: Path) -> None:
    sizes = []
    for n_epochs in (5, 10, 20):
        done = scilab_rl(*RANDOM, f"n_epochs={n_epochs}", cwd=tmp_path)
        assert done.code == 0, done.errors
        run = last_run(tmp_path)
        assert result_of(run)["steps"] == 100 * n_epochs
        lines = (run / "metrics.jsonl").read_text().splitlines()
        n_episodes = sum('"episode"' in line and '"kind": "episode"' in line for line in lines)
        assert n_episodes == 100 * n_epochs // 15
        assert len(lines) == n_episodes + n_epochs
        assert (run / "train.log").stat().st_size == 0
        sizes.append(len(max(lines, key=len)))
    assert max(sizes) < 1000  # bytes of the longest line, however long the run


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # MLflow's own
def test_runs_at_the_same_time_on_one_mlflow_database(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow")
    from .harness import Process

    words = [word for word in RANDOM if word not in ("mlflow=0", "seed=7")]
    processes = [Process((*words, "mlflow=1", f"seed={n}"), tmp_path) for n in range(1, 21)]
    codes = [process.wait(900).code for process in processes]
    assert codes == [0] * 20
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'data' / 'mlflow.db'}")
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    runs = client.search_runs(experiments, max_results=100)
    assert len(runs) == 20
    for run in runs:
        assert run.info.status == "FINISHED"
        history = client.get_metric_history(run.info.run_id, "eval/mean_reward")
        assert [metric.step for metric in history] == [100, 200, 300]


def test_a_cut_line_never_hides_the_others(tmp_path: Path) -> None:
    from scilab_rl.run.directory import RunDirectory

    lines = [f'{{"kind": "epoch", "epoch": {n}, "step": {n}}}\n' for n in range(1, 4)]
    whole = "".join(lines)
    for end in range(len(whole)):
        (tmp_path / "metrics.jsonl").write_text(whole[:end])
        rows = read_epochs(RunDirectory(tmp_path))
        # A line without its newline may be whole.
        assert len(rows) - whole[:end].count("\n") in (0, 1)
