"""Thin adapters to what starts jobs: Ray, and submitit for SLURM or for processes of this machine.

The released launchers of Hydra for both wait for the slowest run of a batch; here a run begins as
soon as there is room.
"""

from __future__ import annotations

import importlib.util
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.hyperopt import job

_RAY_STORE_BYTES = 100_000_000
_POLL_SECONDS = 0.1
_CHILDREN_SECONDS = 10.0
_COMMON_WORDS = ("name", "timeout_min", "mem_gb", "cpus_per_task", "gpus_per_node")
_FORCED_CHECK_SECONDS = 30.0  # between questions to SLURM about all jobs


class RayScheduler:
    """Tasks of a Ray cluster; its machines need the same installation and the same files.

    Args:
        address: The cluster, ``auto`` or HOST:PORT; None starts Ray on this machine alone.
        cpus_per_run: Cores that Ray reserves for a run.
        gpus_per_run: Accelerators that Ray reserves for a run, also a share of one.
    """

    def __init__(
        self, address: str | None = None, cpus_per_run: int = 1, gpus_per_run: float = 0
    ) -> None:
        _require("ray", "ray", "for hydra/launcher=ray")
        ray = _join_ray(address) if address else _start_ray()
        self._ray = ray
        # Repeating a run is for the study to decide. A failed job must not be hidden either.
        options = {"num_cpus": cpus_per_run, "num_gpus": gpus_per_run, "max_retries": 0}
        self._run = ray.remote(**options)(job.run)
        self.n_slots = max(1, int(ray.cluster_resources().get("CPU", 1) // cpus_per_run))

    def submit(self, folder: Path) -> Any:
        """Let Ray run a job."""
        return self._run.remote(str(folder))

    def end_of(self, handle: Any) -> str | None:
        """Return how a job has ended, or None when it is queued or running."""
        if not self._ray.wait([handle], timeout=0)[0]:
            return None
        try:
            self._ray.get(handle)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the end of the job
            return f"the Ray task died: {_first_line(error)}"
        return "the Ray task ended without a result"

    def cancel(self, handle: Any) -> None:
        """End a job at once."""
        self._ray.cancel(handle, force=True)

    def close(self) -> None:
        """Leave the cluster; end it when it is ours."""
        self._ray.shutdown()


class SubmititScheduler:
    """Jobs of SLURM, or processes of this machine, by submitit.

    Args:
        cluster: ``slurm`` or ``local``.
        folder: For the scripts and the output of the jobs; all machines must see it.
        parameters: What each job asks for, in submitit's words; None is left out.
    """

    def __init__(self, cluster: str, folder: Path, parameters: Mapping[str, Any]) -> None:
        _require("submitit", "slurm", f"for hydra/launcher=submitit_{cluster}")
        import submitit

        asked = {
            # What is not one of submitit's common words is meant for SLURM.
            key if key in _COMMON_WORDS else f"slurm_{key}": value
            for key, value in parameters.items()
            if value is not None
        }
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
            self._executor.update_parameters(**asked)
        except (RuntimeError, ValueError, NameError) as error:
            raise ConfigError(f"hydra/launcher=submitit_{cluster}: {_first_line(error)}") from error
        self._next_forced_check = 0.0
        self._has_children = cluster == "local"
        self._children: list[Any] = []  # processes whose end has not been taken note of

    def submit(self, folder: Path) -> Any:
        """Put a job into the queue."""
        handle = self._executor.submit(job.run, str(folder))
        if self._has_children:
            self._children = [one for one in self._children if not one.done()] + [handle]
        return handle

    def end_of(self, handle: Any) -> str | None:
        """Return how a job has ended, or None when it is queued or running."""
        forced = time.monotonic() > self._next_forced_check
        if forced:
            self._next_forced_check = time.monotonic() + _FORCED_CHECK_SECONDS
        if not handle.done(force_check=forced):
            return None
        return f"the job {handle.job_id} has ended without a result; see {handle.paths.stderr}"

    def cancel(self, handle: Any) -> None:
        """End a job at once."""
        handle.cancel(check=False)

    def close(self) -> None:
        """Wait for processes that have said their last word to end."""
        until = time.monotonic() + _CHILDREN_SECONDS
        while time.monotonic() < until and not all(one.done() for one in self._children):
            time.sleep(_POLL_SECONDS)


def _start_ray() -> Any:
    """Start Ray on this machine alone."""
    # Without this, it listens on all networks, whatever address it is given.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    import ray

    ray.init(
        include_dashboard=False,
        log_to_driver=False,
        logging_level="error",
        object_store_memory=_RAY_STORE_BYTES,  # runs exchange files, not objects
    )
    return ray


def _join_ray(address: str) -> Any:
    """Join a cluster; asked first whether it is there, because Ray would wait for minutes.

    Raises:
        ConfigError: If it is not there.
    """
    import ray

    host, _, port = address.rpartition(":")
    try:
        if host and port.isdigit():
            socket.create_connection((host, int(port)), timeout=10).close()
        ray.init(address=address, log_to_driver=False, logging_level="error")
    except (OSError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"hydra.launcher.address={address}: no Ray cluster answers ({_first_line(error)})."
        ) from error
    return ray


def _require(package: str, extra: str, purpose: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise MissingDependencyError(package, extra, purpose)


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
