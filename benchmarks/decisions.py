"""How long a study takes to decide what a free worker shall train next, by the number of its runs.

A decision holds the lock that all processes of a study share: it reads what has changed, looks for
lost runs, races the configurations, stores the chosen run and gives it to a worker. Measured on
SQLite and, with ``--storage``, on a database server; ``repeat`` gives a further run to a known
configuration, ``new`` also asks the random sampler for a new one, ``tpe`` the default sampler,
whose own time grows with what it has learnt. ``cpu`` is the processor time of ``new``, which other
work on the machine does not lengthen. Bar: 50 ms with 10,000 runs for all but ``tpe``.

Prints a table on standard error and JSON on standard output.

Run: python benchmarks/decisions.py [--runs N ...] [--storage URL] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy

from scilab_rl.config.schema import RunConfig
from scilab_rl.parallel.worker import Task
from scilab_rl.search.run_table import RUNS
from scilab_rl.search.runs import COMPLETE, RUNNING, Run
from scilab_rl.search.settings import read_settings
from scilab_rl.search.space import Parameter, SearchSpace
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.study import RunPlan, Study

BAR_MS, N_REPEATS, N_DECISIONS, EPOCHS = 50.0, 3, 20, 20
SPACE = SearchSpace([Parameter(f"++x{i}", "float", 0.0, 1.0) for i in range(3)])


class EndlessPool:
    """Has room for one run more, again and again, and trains none."""

    n_busy = 0

    def __init__(self) -> None:
        self.has_taken = False

    def has_room(self) -> bool:
        """Return whether this decision has not been made yet."""
        return not self.has_taken

    def submit(self, number: int, task: Task) -> None:
        """Take the run."""
        self.has_taken = True


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--storage", help="address of a database server to measure as well")
    parser.add_argument("--json", type=Path, help="also write the JSON to this file")
    arguments = parser.parse_args()
    result: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for count in arguments.runs:
            for url in (None, arguments.storage)[: 1 + bool(arguments.storage)]:
                name = f"{'sqlite' if url is None else url.partition(':')[0]}, {count} runs"
                directory = Path(folder) / f"decisions-{time.time_ns()}"
                result[name] = milliseconds(directory, url, count)
                figures = "  ".join(f"{kind} {ms:7.1f}" for kind, ms in result[name].items())
                sys.stderr.write(f"{name:28}{figures} ms (bar {BAR_MS:g}, but for tpe)\n")
    text = json.dumps(result, indent=2) + "\n"
    sys.stdout.write(text)
    if arguments.json:
        arguments.json.write_text(text, encoding="utf-8")


def milliseconds(directory: Path, url: str | None, count: int) -> dict[str, float]:
    """Return the median time of a decision of each kind, and of opening the study."""
    fill(StudyStorage(directory, url), count)
    started = time.perf_counter()
    storage = StudyStorage(directory, url)
    opened = {"open": 1000 * (time.perf_counter() - started)}
    repeat, _ = decide(storage, "random", 2 * count)
    new, cpu = decide(storage, "random", 4 * count)
    tpe, _ = decide(storage, "tpe", 4 * count)
    return opened | {"repeat": repeat, "new": new, "cpu": cpu, "tpe": tpe}


def fill(storage: StudyStorage, count: int) -> None:
    """Store finished runs and their configurations."""
    rng, rows = random.Random(0), []
    anywhere = optuna.distributions.FloatDistribution(0, 1)
    for trial in range(count // N_REPEATS):
        params = {f"x{i}": rng.random() for i in range(3)}
        storage.study.add_trial(
            optuna.trial.create_trial(
                params=params, distributions=dict.fromkeys(params, anywhere), value=params["x0"]
            )
        )
        for repeat in range(N_REPEATS):
            number = N_REPEATS * trial + repeat
            curve = (params["x0"] + rng.gauss(0, 0.1),) * EPOCHS
            run = Run(
                number, trial, repeat, repeat, COMPLETE, "nobody", 0.0, curve[-1:], curve,
                tuple(range(EPOCHS)), 1.0, f"data/runs/{number}",
            )  # fmt: skip
            rows.append({"number": number, "version": number + 1, "state": run.state,
                         "run": json.dumps(run.as_json())})  # fmt: skip
    given = sqlalchemy.insert(RUNS).values(study_id=storage.study._study_id)
    with sqlalchemy.create_engine(storage.url).begin() as connection:
        connection.execute(given, rows)


def decide(storage: StudyStorage, sampler: str, budget: int) -> tuple[float, float]:
    """Return the median time of decisions and that of the processor, in milliseconds."""
    given: dict[str, Any] = {
        "max_trials": budget, "min_trials_per_param": N_REPEATS, "sampler": sampler,
        "pruner": "none",
    }  # fmt: skip
    plan = RunPlan((), RunConfig(n_epochs=EPOCHS, eval_after_n_steps=1), seed=1)
    pool = EndlessPool()
    study = Study(storage, pool, SPACE, read_settings(given), plan)  # type: ignore[arg-type]
    storage.transact(storage.acquire_lease)
    storage.allow_running()
    times, processor = [], []
    for _ in range(N_DECISIONS + 1):
        pool.has_taken = False
        started, started_cpu = time.perf_counter(), time.thread_time()
        storage.transact(study._look_and_submit)
        times.append(1000 * (time.perf_counter() - started))
        processor.append(1000 * (time.thread_time() - started_cpu))
        assert pool.has_taken
    for run in storage.runs():  # the next study must not take them for lost
        if run.state == RUNNING:
            storage.write_run(run.with_(state=COMPLETE, scores=(0.5,), values=(0.5,), steps=(1,)))
    storage.release_lease()
    # The first reads everything.
    return statistics.median(times[1:]), statistics.median(processor[1:])


if __name__ == "__main__":
    main()
