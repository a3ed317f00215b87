"""The runs of a grid as jobs of a scheduler: each once, no search, no pruning."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from scilab_rl.config.compose import compose
from scilab_rl.errors import SomeRunsFailedError
from scilab_rl.parallel.jobs import JobPool
from scilab_rl.parallel.launchers import open_pool
from scilab_rl.parallel.pool import Pool
from scilab_rl.parallel.worker import Message, Task
from scilab_rl.run.checks import check_metrics, complete

_POLL_SECONDS = 0.5
_log = logging.getLogger(__name__)


def run(
    launcher: Mapping[str, object], grid: Sequence[Sequence[str]], n_jobs: int | None, folder: Path
) -> None:
    """Train each run of a grid once.

    Args:
        launcher: The mapping ``hydra.launcher``.
        grid: The overrides of each run.
        n_jobs: Runs at the same time; None means one per core.
        folder: Where the jobs write what they print.

    Raises:
        ConfigError: If a run cannot work; nothing has been started.
        SomeRunsFailedError: If runs have failed.
    """
    tasks = []
    for overrides in grid:
        words = tuple(word for word in overrides if not _is_hydra_s(word))
        cfg = complete(compose(words))
        check_metrics(cfg)
        tasks.append(Task(words, cfg.hyperopt_criterion))
    failures = []
    with open_pool(launcher, n_jobs, folder) as pool:
        for number, message in outcomes(pool, tasks):
            described = " ".join(tasks[number].overrides)
            if message.kind == "finished":
                _log.info("run %d (%s): %s", number, described, message.content["run_dir"])
            else:
                _log.info("run %d (%s): FAILED: %s", number, described, message.content["error"])
                failures.append(message.content["error"])
    if failures:
        raise SomeRunsFailedError(
            f"{len(failures)} of {len(tasks)} runs failed, first with: {failures[0]}"
        )


def outcomes(
    pool: Pool | JobPool,
    tasks: Sequence[Task],
    on_evaluation: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[int, Message]]:
    """Yield the last message of each run, as they come.

    Args:
        pool: Where they train.
        tasks: The runs.
        on_evaluation: Called with the number of a run and its steps after each evaluation.
    """
    waiting = list(enumerate(tasks))
    while waiting or pool.n_busy:
        while waiting and pool.has_room():
            pool.submit(*waiting.pop(0))
        for number, message in pool.messages(_POLL_SECONDS):
            if message.kind == "evaluated":
                pool.answer(number, True)
                if on_evaluation is not None:
                    on_evaluation(number, message.content["step"])
            elif message.kind != "started":
                yield number, message


def _is_hydra_s(override: str) -> bool:
    return override.lstrip("+~").startswith(("hydra.", "hydra/"))
