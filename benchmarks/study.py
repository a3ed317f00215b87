"""How much of the workers' time a study spends on training, and what a training costs beside.

Two studies with real worker processes, a real sampler and a real database:

* ``unequal``: runs that only wait, with lengths mixed 1:5. ``busy_share`` is the share of the
  workers' time, from when all have started to the start of the last run, that is inside a run
  (bar: at least 0.95). A study that waits for the slowest run of each batch, as common sweepers do,
  would reach ``busy_share_in_batches`` with the same runs in the same order.
* ``trainings``: short trainings of SAC. ``overhead_seconds`` is what each of them keeps a worker
  from the next one beside learning: decision, database, configuration, building, report of the
  result (bar: less than 3 s); ``first_overhead_seconds`` is that of each worker's first run, which
  starts the process and imports everything.

Prints a table on standard error and JSON on standard output.

Run: python benchmarks/study.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from scilab_rl.config.schema import RunConfig
from scilab_rl.parallel import worker
from scilab_rl.parallel.pool import Pool, n_cores
from scilab_rl.parallel.worker import Message, Task
from scilab_rl.search.runs import RUNNING, Run
from scilab_rl.search.settings import read_settings
from scilab_rl.search.space import Parameter, SearchSpace
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.study import RunPlan, Study

SECONDS = (3.0, 6.0, 9.0, 12.0, 15.0)
N_WAITING, N_TRAININGS, N_WORKERS = 40, 12, 4  # waiting needs no core, so four at a time
EVALUATIONS = 10
BUSY_BAR, OVERHEAD_BAR = 0.95, 3.0
TRAINING = (
    "algorithm=sac", "env=scilab_rl.testing:TinyReach-v0", "n_epochs=2", "eval_after_n_steps=100",
    "n_test_rollouts=2", "mlflow=0", "algorithm.buffer_size=1000", "algorithm.learning_starts=100",
    "early_stop_threshold=2", "++tracking.console.enabled=false",
)  # fmt: skip


class Clock:
    """Notes when each run ended, as an observer of the study."""

    def __init__(self) -> None:
        self.ends: dict[int, float] = {}

    def update(self, runs: Sequence[Run]) -> None:
        """Note the time of the runs that have just ended."""
        for run in runs:
            if run.state != RUNNING:
                self.ends.setdefault(run.number, time.time())


def main() -> None:
    """Measure both studies and print them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--json", type=lambda name: Path(name).absolute(), help="also write the JSON to this file"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        result = {"unequal": unequal(Path("unequal")), "trainings": trainings(Path("trainings"))}
    result["load_average"] = os.getloadavg()[0]
    share, overhead = result["unequal"]["busy_share"], result["trainings"]["overhead_seconds"]
    for name, value, bar, met in (
        ("busy share, runs 1:5", share, f">= {BUSY_BAR}", share >= BUSY_BAR),
        ("overhead per run (s)", overhead, f"< {OVERHEAD_BAR}", overhead < OVERHEAD_BAR),
    ):
        sys.stderr.write(f"{name:24}{value:8.3f}   {bar:8} {'met' if met else 'MISSED'}\n")
    text = json.dumps(result, indent=2) + "\n"
    sys.stdout.write(text)
    if arguments.json:
        arguments.json.write_text(text, encoding="utf-8")


def unequal(folder: Path) -> dict[str, Any]:
    """Return the busy share of workers whose runs differ in length."""
    space = SearchSpace([
        Parameter("++seconds", "categorical", choices=SECONDS),
        Parameter("++x", "float", 0.0, 1.0),
    ])  # fmt: skip
    with Pool(N_WORKERS, folder / "workers", main=wait_for_seconds) as pool:
        runs, clock = work(folder, pool, space, (), N_WAITING, EVALUATIONS)
    spans = [(clock.ends[run.number] - run.seconds, clock.ends[run.number]) for run in runs]
    first = sorted(start for start, _ in spans)[N_WORKERS - 1]
    last = max(run.started for run in runs)
    busy = sum(max(0.0, min(end, last) - max(start, first)) for start, end in spans)
    total = N_WORKERS * (last - first)
    return {
        "busy_share": busy / total,
        "idle_seconds_per_run": (total - busy) / len(runs),
        "mean_seconds": statistics.mean(run.seconds for run in runs),
        "busy_share_in_batches": share_in_batches([run.seconds for run in runs]),
        "runs": len(runs),
        "workers": N_WORKERS,
    }


def share_in_batches(seconds: Sequence[float]) -> float:
    """Return the busy share if each batch of runs waited for its slowest one."""
    batches = [seconds[i : i + N_WORKERS] for i in range(0, len(seconds), N_WORKERS)]
    return sum(seconds) / (N_WORKERS * sum(map(max, batches)))


def trainings(folder: Path) -> dict[str, Any]:
    """Return what a training costs beside learning."""
    space = SearchSpace([Parameter("++algorithm.gamma", "float", 0.9, 0.99)])
    size = n_cores()
    with Pool(size, folder / "workers", main=worker.main) as pool:
        runs, clock = work(folder, pool, space, TRAINING, N_TRAININGS, epochs=2)
    overheads = [clock.ends[run.number] - run.started - run.seconds for run in runs]
    return {
        "overhead_seconds": statistics.mean(overheads[size:]),
        "largest_overhead_seconds": max(overheads[size:]),
        "first_overhead_seconds": statistics.mean(overheads[:size]),
        "learning_seconds": statistics.mean(run.seconds for run in runs),
        "runs": len(runs),
        "workers": size,
    }


def work(
    folder: Path, pool: Pool, space: SearchSpace, fixed: tuple[str, ...], count: int, epochs: int
) -> tuple[list[Run], Clock]:
    """Run a study and return its runs and when they ended."""
    settings = read_settings(
        {"max_trials": count, "min_trials_per_param": 2, "n_final_runs": 0, "pruner": "none"}
    )
    plan = RunPlan(fixed, RunConfig(n_epochs=epochs, eval_after_n_steps=200), seed=1)
    clock = Clock()
    study = Study(StudyStorage(folder), pool, space, settings, plan, clock.update)
    study.work()
    return study.runs, clock


def wait_for_seconds(connection: Connection, log_path: str, n_threads: int) -> None:
    """Follow the protocol of `worker.main` with runs that only wait."""
    connection.send(Message("ready"))
    try:
        while (task := connection.recv()) is not None:
            connection.send(wait_once(task, connection))
    except EOFError:
        return


def wait_once(task: Task, connection: Connection) -> Message:
    """Wait as long as the task says, with evaluations between."""
    given = dict(word.lstrip("+").split("=") for word in task.overrides)
    started, values, steps = time.monotonic(), [], []
    for epoch in range(1, EVALUATIONS + 1):
        time.sleep(float(given["seconds"]) / EVALUATIONS)
        values.append(1 - (float(given["x"]) - 0.7) ** 2 + epoch / 100)
        steps.append(200 * epoch)
        content = {"epoch": epoch, "step": steps[-1], "value": values[-1]}
        connection.send(Message("evaluated", content))
        connection.recv()
    result = {"status": "finished", "run_dir": "", "values": values, "steps": steps}
    return Message("finished", result | {"seconds": time.monotonic() - started})


if __name__ == "__main__":
    main()
