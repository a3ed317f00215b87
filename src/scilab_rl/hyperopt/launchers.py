"""Where runs are trained, by ``hydra/launcher=local|ray|submitit_local|submitit_slurm``."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scilab_rl.errors import ConfigError
from scilab_rl.hyperopt.jobs import JobPool
from scilab_rl.hyperopt.pool import Pool
from scilab_rl.hyperopt.schedulers import RayScheduler, SubmititScheduler
from scilab_rl.machine import n_cores

_SLURM_JOBS = 16
_log = logging.getLogger(__name__)


def open_pool(launcher: Mapping[str, Any], n_jobs: int | None, directory: Path) -> Pool | JobPool:
    """Return what trains the runs of a study or of a grid.

    Args:
        launcher: The mapping ``hydra.launcher``.
        n_jobs: Most runs at the same time; None means what the launcher's file says.
        directory: Folder for the files that this needs.

    Raises:
        ConfigError: If the launcher is not one of ours, or cannot work.
    """
    given = {key: value for key, value in launcher.items() if key not in ("_target_", "kind")}
    kind = launcher.get("kind", "local")
    if str(launcher.get("_target_", "")).rpartition(".")[2] not in ("BasicLauncher", "JobLauncher"):
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
    """Return how many runs go on at once on this machine: never more than there are cores.

    A run keeps one core busy. More of them at a time end no sooner and need more memory.
    """
    cores = n_cores()
    if n_jobs is not None and n_jobs > cores:
        _log.info("n_jobs=%d, but there are %d cores: %d runs at a time.", n_jobs, cores, cores)
    return min(n_jobs or cores, cores)
