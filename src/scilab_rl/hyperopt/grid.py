"""The runs of a grid as jobs of a scheduler: each once, no search, no pruning."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from scilab_rl import assembly, config
from scilab_rl.errors import SomeRunsFailedError
from scilab_rl.hyperopt.jobs import JobPool
from scilab_rl.hyperopt.launchers import open_pool
from scilab_rl.hyperopt.pool import Pool
from scilab_rl.hyperopt.worker import Message, Task

_POLL_SECONDS = 0.5
_log = logging.getLogger(__name__)


def run(launcher: Mapping[str, Any], grid: Sequence[Sequence[str]], cfg: DictConfig) -> None:
    """Train each run of a grid once.

    Args:
        launcher: The mapping ``hydra.launcher``.
        grid: The overrides of each run.
        cfg: The configuration of the multirun, with ``hydra.sweep.dir``.

    Raises:
        ConfigError: If a run cannot work; nothing has been started.
        SomeRunsFailedError: If runs have failed.
    """
    plans = [tuple(word for word in overrides if not _is_hydra_s(word)) for overrides in grid]
    tasks = [Task(plan, cfg.hyperopt_criterion) for plan in plans]
    for task in tasks:
        assembly.complete(config.compose(task.overrides))
    failures = []
    with open_pool(launcher, cfg.hydra.sweeper.n_jobs, Path(cfg.hydra.sweep.dir)) as pool:
        for number, message in outcomes(pool, tasks):
            words = " ".join(tasks[number].overrides)
            if message.kind == "finished":
                _log.info("run %d (%s): %s", number, words, message.content["run_dir"])
            else:
                _log.info("run %d (%s): FAILED: %s", number, words, message.content["error"])
                failures.append(message.content["error"])
    if failures:
        raise SomeRunsFailedError(
            f"{len(failures)} of {len(tasks)} runs failed, first with: {failures[0]}"
        )


def outcomes(pool: Pool | JobPool, tasks: Sequence[Task]) -> Iterator[tuple[int, Message]]:
    """Yield the last message of each run, as they come."""
    waiting = list(enumerate(tasks))
    while waiting or pool.n_busy:
        while waiting and pool.has_room():
            pool.submit(*waiting.pop(0))
        for number, message in pool.messages(_POLL_SECONDS):
            if message.kind == "evaluated":
                pool.answer(number, True)
            elif message.kind != "started":
                yield number, message


def _is_hydra_s(override: str) -> bool:
    return override.lstrip("+~").startswith(("hydra.", "hydra/"))
