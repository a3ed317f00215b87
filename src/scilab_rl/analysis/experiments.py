"""An experiment: the same seeds for every group; existing runs are reused."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scilab_rl.analysis.groups import INCOMPLETE, Group, read_records
from scilab_rl.config.compose import compose
from scilab_rl.config.schema import learning_config
from scilab_rl.parallel.grid import outcomes
from scilab_rl.parallel.launchers import open_pool
from scilab_rl.parallel.worker import Task
from scilab_rl.run.checks import check_metrics, complete

_log = logging.getLogger(__name__)
_QUIET = "++tracking.console.enabled=false"


@dataclass(frozen=True)
class PlannedGroup:
    """A group of runs that an experiment compares.

    Attributes:
        label: Its name.
        overrides: The command line of all its runs, without the seed.
        config: The part of their configuration that affects learning.
        criterion: The metric to report while they train.
        seeds: The seeds.
        missing: The seeds without a complete run.
    """

    label: str
    overrides: tuple[str, ...]
    config: Mapping[str, str]
    criterion: str
    seeds: tuple[int, ...]
    missing: tuple[int, ...]

    def group(self, base: Path) -> Group:
        """Return its runs: the newest complete one of each seed, else the newest."""
        matching = [run for run in read_records(base) if run.config == self.config]
        newest = {run.seed: run for run in matching}
        newest |= {run.seed: run for run in matching if run.status not in INCOMPLETE}
        chosen = (newest.get(seed) for seed in self.seeds)
        return Group(
            self.label, " ".join(self.overrides), tuple(run for run in chosen if run is not None)
        )


def plan(
    groups: Mapping[str, Sequence[str]],
    fixed: Sequence[str],
    n_seeds: int,
    first_seed: int,
    base: Path,
) -> list[PlannedGroup]:
    """Compose and check each group, and find its existing runs.

    A run belongs to a group if everything in its configuration that affects learning is equal.

    Raises:
        ConfigError: If a configuration is invalid; nothing has been started.
    """
    seeds = tuple(range(first_seed, first_seed + n_seeds))
    records, planned = read_records(base), []
    for label, overrides in groups.items():
        words = (*overrides, *fixed)
        cfg = complete(compose([*words, f"base_logdir={base}"]))
        check_metrics(cfg)
        learning = learning_config(cfg.values())
        finished = {
            run.seed for run in records if run.config == learning and run.status not in INCOMPLETE
        }
        planned.append(
            PlannedGroup(
                label, (*words, f"base_logdir={base}"), learning, cfg.hyperopt_criterion, seeds,
                tuple(seed for seed in seeds if seed not in finished),
            )
        )  # fmt: skip
    return planned


def train_missing(
    groups: Sequence[PlannedGroup], launcher: Mapping[str, object], n_jobs: int | None, folder: Path
) -> list[str]:
    """Train the missing runs, seed by seed, and return the errors of those that failed."""
    planned = [
        (group.label, seed, Task((*group.overrides, _QUIET, f"seed={seed}"), group.criterion))
        for seed in groups[0].seeds
        for group in groups
        if seed in group.missing
    ]
    if not planned:
        return []
    failures = []
    with open_pool(launcher, n_jobs, folder) as pool:
        for number, message in outcomes(pool, [task for _, _, task in planned]):
            label, seed, _ = planned[number]
            if message.kind == "finished":
                values = message.content["values"]
                score = f"{values[-1]:.3g}" if values else "no value"
                _log.info("%s, seed %d: %s", label, seed, score)
            else:
                _log.info("%s, seed %d: FAILED: %s", label, seed, message.content["error"])
                failures.append(str(message.content["error"]))
    return failures
