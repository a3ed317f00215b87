"""An experiment: the same seeds for every side, and no run trained twice."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from scilab_rl import assembly, config
from scilab_rl.hyperopt.grid import outcomes
from scilab_rl.hyperopt.launchers import open_pool
from scilab_rl.hyperopt.worker import Task
from scilab_rl.performance.groups import (
    FAILED,
    UNFINISHED,
    Group,
    RunRecord,
    identity_of,
    read_records,
)

_log = logging.getLogger(__name__)
# They do not change what a run learns.
_QUIET = "++tracking.console.enabled=false"


@dataclass(frozen=True)
class PlannedSide:
    """One side of an experiment.

    Attributes:
        label: Its name.
        overrides: What all its runs are told, without the seed.
        identity: What its runs have in their configuration.
        criterion: The metric to report while they train.
        seeds: The seeds.
        missing: Those of which there is no whole run yet.
    """

    label: str
    overrides: tuple[str, ...]
    identity: Mapping[str, str]
    criterion: str
    seeds: tuple[int, ...]
    missing: tuple[int, ...]

    def group(self, base: Path) -> Group:
        """Return its runs, the newest of each seed."""
        alike = _alike(read_records(base), self.identity)
        newest = {run.seed: run for run in alike}
        whole = {run.seed: run for run in alike if _is_whole(run)}
        chosen = (whole.get(seed) or newest.get(seed) for seed in self.seeds)
        return Group(
            self.label, " ".join(self.overrides), tuple(run for run in chosen if run is not None)
        )


def plan(
    sides: Mapping[str, Sequence[str]],
    fixed: Sequence[str],
    n_seeds: int,
    first_seed: int,
    base: Path,
) -> list[PlannedSide]:
    """Compose and check each side, and find out which runs are there already.

    A run counts when its whole configuration is the same, whatever it was started for.

    Must run inside ``hydra.initialize...``.

    Raises:
        ConfigError: If a side cannot work; nothing has been started.
    """
    seeds = tuple(range(first_seed, first_seed + n_seeds))
    records, planned = read_records(base), []
    for label, overrides in sides.items():
        words = tuple(config.friendly_override(word) for word in (*overrides, *fixed))
        cfg = assembly.complete(config.compose([*words, f"base_logdir={base}"]))
        identity = identity_of(OmegaConf.to_container(cfg, resolve=True))
        there = {run.seed for run in _alike(records, identity) if _is_whole(run)}
        planned.append(
            PlannedSide(
                label, (*words, f"base_logdir={base}"), identity, cfg.hyperopt_criterion, seeds,
                tuple(seed for seed in seeds if seed not in there),
            )
        )  # fmt: skip
    return planned


def train_missing(
    sides: Sequence[PlannedSide], launcher: Mapping[str, Any], n_jobs: int | None, folder: Path
) -> list[str]:
    """Train the missing runs, seed by seed, and return what failed."""
    planned = [
        (side.label, seed, Task((*side.overrides, _QUIET, f"seed={seed}"), side.criterion))
        for seed in sides[0].seeds
        for side in sides
        if seed in side.missing
    ]
    if not planned:
        return []
    failures = []
    with open_pool(launcher, n_jobs, folder) as pool:
        for number, message in outcomes(pool, [task for _, _, task in planned]):
            label, seed, _ = planned[number]
            if message.kind == "finished":
                values = message.content["values"]
                told = f"{values[-1]:.3g}" if values else "nothing"
                _log.info("%s, seed %d: %s", label, seed, told)
            else:
                _log.info("%s, seed %d: FAILED: %s", label, seed, message.content["error"])
                failures.append(str(message.content["error"]))
    return failures


def _alike(records: Sequence[RunRecord], identity: Mapping[str, str]) -> list[RunRecord]:
    return [run for run in records if dict(run.config) == dict(identity)]


def _is_whole(run: RunRecord) -> bool:
    return run.status not in (FAILED, *UNFINISHED)
