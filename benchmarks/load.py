"""What a long night does to the framework: many trials, many runs at once, many steps, many values.

* ``study``: 200 short trials on two workers; every 5 to 20 seconds a worker or the parent is
  killed, and the same command is given again. Bar: exactly 200 runs are accounted for.
* ``mlflow``: 20 runs at the same time on one MLflow database. Bar: nothing is lost.
* ``steps``: two million steps of one run with eight environments. Bar: memory is flat after the
  first tenth, and files grow by a line per episode and a row per epoch.
* ``metrics``: values recorded per second, and values written per second. Bar: 10 000 each.

Prints one JSON object per part.

Run: python benchmarks/load.py PART [--scale FRACTION] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.config.schema import RunConfig
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.results import RunResult
from scilab_rl.run.directory import all_runs, read_epochs
from scilab_rl.search.storage import open_study
from scilab_rl.tracking.base import TrackedRun
from scilab_rl.tracking.files import FilesTracker

ENV = "env=scilab_rl.testing:TinyReach-v0"
SHORT = ("algorithm=random", ENV, "n_epochs=1", "eval_after_n_steps=30", "n_test_rollouts=1")
_MAIN = str(Path(__file__).parents[1] / "src" / "main.py")


def study(folder: Path, scale: float, pause: float = 1.0) -> dict[str, Any]:
    """Kill workers and parents of a study until it has ended."""
    n_trials, rng, kills = max(4, int(200 * scale)), random.Random(0), Counter[str]()
    words = [
        *SHORT, "mlflow=0", "tuned=false", "early_stop_threshold=interval(0.5,1.0)", "--multirun",
        f"hydra.sweeper.max_trials={n_trials}", "hydra.sweeper.n_jobs=2",
        "hydra.sweeper.min_trials_per_param=1",
        "hydra.sweeper.n_final_runs=0", "hydra.sweeper.max_retries=100",
        "hydra.sweeper.study_name=load", "hydra.sweeper.fail_fast=0",
        "hydra.sweeper.sampler=random",
    ]  # fmt: skip
    started, starts = time.monotonic(), 0
    process = _start(words, folder)
    code = None
    while code is None:
        try:
            code = process.wait(pause * rng.uniform(5, 20))
        except subprocess.TimeoutExpired:
            workers = _children(process.pid)
            if workers and rng.random() < 0.6:
                kills["worker"] += _kill(rng.choice(workers))
            else:
                kills["parent"] += _kill(process.pid)
                process.wait()
                process, starts = _start(words, folder), starts + 1
    runs = open_study(folder / "data" / "studies" / "load").runs()
    states = Counter(run.state for run in runs)
    return {
        "trials": n_trials,
        "runs": len(runs),
        "distinct": len({(run.trial, run.repeat) for run in runs}),
        "states": dict(states),
        "kills": dict(kills),
        "starts": starts + 1,
        "attempts_again": sum(run.attempt for run in runs),
        "exit_code": code,
        "seconds": round(time.monotonic() - started),
        "ok": len(runs) == n_trials == states["complete"] and code == 0,
    }


def mlflow(folder: Path, scale: float) -> dict[str, Any]:
    """Start many runs at once and count what the database holds afterwards."""
    from mlflow import MlflowClient

    n_runs, n_epochs = max(2, int(20 * scale)), 5
    started = time.monotonic()
    words = [*SHORT[:2], f"n_epochs={n_epochs}", *SHORT[3:], "tuned=false", "mlflow=1"]
    processes = [_start([*words, f"seed={seed}"], folder) for seed in range(1, n_runs + 1)]
    codes = Counter(process.wait() for process in processes)
    client = MlflowClient(f"sqlite:///{(folder / 'data' / 'mlflow.db').resolve()}")
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    found = client.search_runs(experiments, max_results=1000)
    complete = [
        run
        for run in found
        if run.info.status == "FINISHED"
        and len(client.get_metric_history(run.info.run_id, "eval/mean_reward")) == n_epochs
    ]
    n_files = sum(len(read_epochs(run)) == n_epochs for run in all_runs(folder / "data"))
    return {
        "runs": n_runs,
        "exit_codes": {str(code): n for code, n in codes.items()},
        "in_database": len(found),
        "complete_in_database": len(complete),
        "complete_in_files": n_files,
        "seconds": round(time.monotonic() - started),
        "ok": len(found) == len(complete) == n_files == n_runs,
    }


def steps(folder: Path, scale: float) -> dict[str, Any]:
    """Follow memory and files of one long run."""
    n_steps = int(2_000_000 * scale)
    words = [
        "algorithm=random", ENV, "n_envs=8", f"n_epochs={n_steps // 10_000}",
        "eval_after_n_steps=10000",
        "n_test_rollouts=1", "tuned=false", "mlflow=0", "seed=1", "early_stop_threshold=2",
        f"save_model_freq={n_steps // 10}",
    ]  # fmt: skip
    started = time.monotonic()
    process = _start(words, folder)
    samples: list[tuple[int, float]] = []
    while process.poll() is None:
        time.sleep(1.0)
        runs = list(all_runs(folder / "data"))
        step = _newest_step(runs[0] / "metrics.csv") if runs else 0
        if step and (resident := _resident_mib(process.pid)):
            samples.append((step, resident))
    settled = [mib for step, mib in samples if step >= n_steps * 0.1]
    (run,) = all_runs(folder / "data")
    n_episodes = sum('"episode"' in line for line in (run / "metrics.jsonl").open())
    sizes = {
        name: (run / name).stat().st_size for name in ("metrics.jsonl", "metrics.csv", "train.log")
    }
    kept = sum(path.stat().st_size for path in (run / "checkpoints").rglob("*") if path.is_file())
    growth = settled[-1] - settled[0]
    return {
        "steps": n_steps,
        "seconds": round(time.monotonic() - started),
        "steps_per_second": round(n_steps / (time.monotonic() - started)),
        "resident_mib": {"at_a_tenth": round(settled[0], 1), "at_the_end": round(settled[-1], 1)},
        "episodes": n_episodes,
        "bytes_per_episode": round(sizes["metrics.jsonl"] / max(n_episodes, 1), 1),
        "bytes": sizes | {"checkpoints": kept},
        "exit_code": process.returncode,
        "ok": process.returncode == 0 and growth < 10,
    }


def metrics(folder: Path, scale: float) -> dict[str, Any]:
    """Record and write values as fast as it goes."""
    n = int(200_000 * scale)
    logger = MetricLogger()
    started = time.perf_counter()
    for index in range(n):
        logger.record("train/x", index)
    recorded = n / (time.perf_counter() - started)
    tracker = FilesTracker()
    tracker.begin(TrackedRun(RunConfig(), folder))
    values = {f"train/{index}": value for index, value in enumerate(np.random.rand(50).tolist())}
    n_epochs = max(2, n // 1000)
    started = time.perf_counter()
    for epoch in range(n_epochs):
        tracker.epoch(epoch, epoch, values)
    written = n_epochs * len(values) / (time.perf_counter() - started)
    tracker.end(RunResult("finished", 0.0, 1, 1, 1.0, str(folder)))
    lines = len((folder / "metrics.jsonl").read_text().splitlines())
    return {
        "recorded_per_second": round(recorded),
        "written_per_second": round(written),
        "lines": lines,
        "ok": recorded > 10_000 and written > 10_000 and lines == n_epochs,
    }


PARTS: dict[str, Callable[..., dict[str, Any]]] = {
    "study": study, "mlflow": mlflow, "steps": steps, "metrics": metrics,
}  # fmt: skip


def _start(words: list[str], folder: Path) -> subprocess.Popen:
    with (folder / "output.log").open("a") as log:
        return subprocess.Popen(
            [sys.executable, _MAIN, *words],
            cwd=folder,
            stdout=log,
            stderr=log,
            env=os.environ | {"OMP_NUM_THREADS": "1", "TERM": "dumb"},
        )


def _children(pid: int) -> list[int]:
    try:
        words = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        commands = {int(w): Path(f"/proc/{w}/cmdline").read_text() for w in words}
    except OSError:
        return []
    return [child for child, line in commands.items() if "spawn_main" in line]


def _kill(pid: int) -> int:
    try:
        os.kill(pid, 9)
    except ProcessLookupError:
        return 0
    return 1


def _newest_step(path: Path) -> int:
    try:
        return int(path.read_text().splitlines()[-1].split(",")[1])
    except (OSError, ValueError, IndexError):
        return 0


def _resident_mib(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> int:
    """Run one part and say whether it held."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--scale", type=float, default=1.0, help="of the numbers above")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument(
        "--pause", type=float, default=1.0, help="times 5 to 20 s between kills, on slow machines"
    )
    options = parser.parse_args()
    more = {"pause": options.pause} if options.part == "study" else {}
    with tempfile.TemporaryDirectory() as folder:
        figures = PARTS[options.part](Path(folder), options.scale, **more)
    text = json.dumps({"part": options.part, "scale": options.scale, **more, **figures}, indent=2)
    sys.stdout.write(text + "\n")
    if options.json:
        options.json.write_text(text + "\n", encoding="utf-8")
    return 0 if figures["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
