"""Where runs are trained, by ``hydra/launcher=local|ray|submitit_local|submitit_slurm``."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scilab_rl.config.compose import compose_launcher
from scilab_rl.config.schema import Values
from scilab_rl.errors import ConfigError
from scilab_rl.machine import n_cores
from scilab_rl.parallel.jobs import JobPool
from scilab_rl.parallel.pool import Pool
from scilab_rl.parallel.schedulers import RayScheduler, SubmititScheduler

_SLURM_JOBS = 16
_OURS = ("BasicLauncher", "LocalLauncher", "JobLauncher")
_log = logging.getLogger(__name__)


def read_launcher(commands: Iterable[Sequence[str]]) -> Values:
    """Return the mapping ``hydra.launcher`` that several commands share.

    Args:
        commands: The overrides of each command.

    Raises:
        ConfigError: If they cannot be composed, or choose different launchers.
    """
    found: Values = {}
    for words in commands:
        launcher = compose_launcher(words)
        if found not in ({}, launcher):
            raise ConfigError(
                f"All runs of one command need the same launcher, but there are {_name(found)} and "
                f"{_name(launcher)} with different keys: run one command for each."
            )
        found = launcher
    return found


def refuse_for_single_run(launcher: Mapping[str, object]) -> None:
    """Reject a launcher for a run that this process trains itself.

    Raises:
        ConfigError: If the launcher starts runs elsewhere.
    """
    if launcher.get("kind", "local") != "local" or not _is_ours(launcher):
        raise ConfigError(
            f"hydra/launcher={_name(launcher)} was chosen, but this command trains one run here: "
            "add --multirun to use the launcher, or hydra/launcher=local to train here."
        )


def open_pool(
    launcher: Mapping[str, object], n_jobs: int | None, directory: Path
) -> Pool | JobPool:
    """Return what trains the runs of a study or of a grid.

    Args:
        launcher: The mapping ``hydra.launcher``.
        n_jobs: Most runs at the same time; None means what the launcher's file says.
        directory: Folder for the files that this needs.

    Raises:
        ConfigError: If the launcher is not one of ours, or cannot work.
    """
    given: dict[str, Any] = {
        key: value for key, value in launcher.items() if key not in ("_target_", "kind")
    }
    kind = str(launcher.get("kind", "local"))
    if not _is_ours(launcher):
        raise ConfigError(
            f"A study cannot use {launcher['_target_']}. Choose hydra/launcher=local, ray, "
            "submitit_local or submitit_slurm."
        )
    if kind == "local":
        return Pool(n_workers(n_jobs), directory / "workers")
    jobs = directory / "jobs"
    if kind == "ray":
        ray = RayScheduler(**given)
        return JobPool(n_jobs or ray.n_slots, jobs, ray, given["cpus_per_run"])
    cluster = kind.removeprefix("submitit_")
    submitit = SubmititScheduler(cluster, directory / "submitit", given)
    size = n_workers(n_jobs) if cluster == "local" else n_jobs or _SLURM_JOBS
    return JobPool(size, jobs, submitit, given["cpus_per_task"])


def n_workers(n_jobs: int | None) -> int:
    """Return how many runs train at once on this machine: never more than there are cores.

    A run keeps one core busy. More of them at a time end no sooner and need more memory.
    """
    cores = n_cores()
    if n_jobs is not None and n_jobs > cores:
        _log.info("n_jobs=%d, but there are %d cores: %d runs at a time.", n_jobs, cores, cores)
    return min(n_jobs or cores, cores)


def _is_ours(launcher: Mapping[str, object]) -> bool:
    return str(launcher.get("_target_", "")).rpartition(".")[2] in _OURS


def _name(launcher: Mapping[str, object]) -> str:
    """Return what stands behind ``hydra/launcher=``."""
    return str(launcher.get("kind") or "local" if _is_ours(launcher) else launcher["_target_"])
