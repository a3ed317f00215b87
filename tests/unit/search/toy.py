"""Studies whose runs are made of a formula: real processes, real storage, no training.

As a script, it runs one study and prints why it ended: ``python -m tests.unit.search.toy FOLDER
MAX_TRIALS WORKERS DATABASE [PRUNER]``.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scilab_rl.config.schema import RunConfig
from scilab_rl.parallel.pool import Pool
from scilab_rl.search.settings import read_settings
from scilab_rl.search.space import Parameter, SearchSpace
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.study import RunPlan, Study

from . import toy_worker
from .toy_worker import EPOCH_STEPS, N_EPOCHS

SPACE = SearchSpace([Parameter("++x", "float", 0.0, 1.0)])
CHOICES = SearchSpace([Parameter("++x", "categorical", choices=(0.0, 0.25, 0.5, 0.75, 1.0))])


def run(
    directory: Path,
    *overrides: str,
    space: SearchSpace = SPACE,
    n_workers: int = 2,
    storage: str | None = None,
    open_pool: Callable[[Path], Any] | None = None,
    baseline: dict[str, Any] | None = None,
    **sweeper: Any,
) -> Study:
    """Run a toy study to its end, with workers of this process unless ``open_pool`` says other."""
    given = {"max_trials": 12, "min_trials_per_param": 2, "n_final_runs": 1, "seed": 5} | sweeper
    settings = read_settings(given)
    storage = StudyStorage(directory, storage, settings.directions)
    cfg = RunConfig(n_epochs=N_EPOCHS, eval_after_n_steps=EPOCH_STEPS)
    plan = RunPlan(overrides, cfg, 5, baseline)
    with storage.locked():
        storage.define(definition(space, settings))
    pools = Pool(n_workers, directory / "workers", main=toy_worker.main)
    with open_pool(directory) if open_pool else pools as pool:
        study = Study(storage, pool, space, settings, plan)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: study.interrupt(number))
        try:
            study.work()
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
    return study


def definition(space: SearchSpace, settings: Any) -> dict[str, Any]:
    """Return what `sweep` would store about a study."""
    return {
        "seed": 5, "overrides": ["algorithm=toy"], "space": space.describe(),
        "score": list(settings.score), "directions": list(settings.directions),
        "min_runs": settings.min_trials_per_param, "max_runs": settings.max_trials_per_param,
        "env": "Toy-v0", "algorithm": "toy", "criterion": "eval/success_rate",
        "configuration": {},
    }  # fmt: skip


if __name__ == "__main__":
    folder, trials, workers, url, *pruner = sys.argv[1:]
    done = run(
        Path(folder), "seconds=0.2", max_trials=int(trials), n_workers=int(workers),
        storage=url or None, pruner=pruner[0] if pruner else "median",
    )  # fmt: skip
    sys.stdout.write(f"{done.stop.reason or 'finished'}\n")
