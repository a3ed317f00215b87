"""Thin adapters to what starts jobs: Ray, and submitit for SLURM or for processes of this machine.

The released launchers of Hydra for both wait for the slowest run of a batch; here a run begins as
soon as there is room.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import secrets
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from scilab_rl import telemetry
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError, first_line
from scilab_rl.parallel import job

if TYPE_CHECKING:
    import ray
    import submitit
    from submitit.helpers import DelayedSubmission

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

    def submit(self, folders: Sequence[Path]) -> list[ray.ObjectRef]:
        """Let Ray run jobs."""
        return [self._run.remote(str(folder)) for folder in folders]

    def end_of(self, handle: ray.ObjectRef) -> str | None:
        """Return how a job has ended, or None when it is queued or running."""
        if not self._ray.wait([handle], timeout=0)[0]:
            return None
        try:
            self._ray.get(handle)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the end of the job
            return f"the Ray task died: {first_line(error)}"
        return "the Ray task ended without a result"

    def cancel(self, handle: ray.ObjectRef) -> None:
        """End a job at once."""
        self._ray.cancel(handle, force=True)

    def close(self) -> None:
        """Leave the cluster; end it when it is ours."""
        self._ray.shutdown()


class RequeuedJob:
    """A job that submitit puts into the queue again when SLURM preempts it or its time is over."""

    def __call__(self, folder: str) -> None:
        """Train what the folder describes; from the newest checkpoint, when called again."""
        job.run(folder)

    def checkpoint(self, folder: str) -> DelayedSubmission:
        """Return what is to be called again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, folder)


class SubmititScheduler:
    """Jobs of SLURM, or processes of this machine, by submitit.

    Args:
        cluster: ``slurm`` or ``local``.
        folder: For the scripts and the output of the jobs; all machines must see it.
        parameters: What each job asks for, in submitit's words; None is left out.
    """

    def __init__(self, cluster: str, folder: Path, parameters: Mapping[str, object]) -> None:
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
            raise ConfigError(f"hydra/launcher=submitit_{cluster}: {first_line(error)}") from error
        self._next_forced_check = 0.0
        self._has_children = cluster == "local"
        self._children: list[submitit.Job[None]] = []  # whose end nobody has noted

    def submit(self, folders: Sequence[Path]) -> list[submitit.Job[None]]:
        """Put jobs into the queue, several as one array.

        Raises:
            ScilabRLError: If SLURM refuses them.
        """
        from submitit.core.utils import FailedJobError

        try:
            with self._executor.batch():
                handles = [self._executor.submit(RequeuedJob(), str(folder)) for folder in folders]
        except FailedJobError as error:
            *_, last = str(error).strip().splitlines()
            raise ScilabRLError(f"SLURM does not take the jobs: {last}") from error
        if self._has_children:
            self._children = [one for one in self._children if not one.done()] + handles
        return handles

    def end_of(self, handle: submitit.Job[None]) -> str | None:
        """Return how a job has ended, or None when it is queued or running."""
        forced = time.monotonic() > self._next_forced_check
        if forced:
            self._next_forced_check = time.monotonic() + _FORCED_CHECK_SECONDS
        if not handle.done(force_check=forced):
            return None
        return f"the job {handle.job_id} has ended without a result; see {handle.paths.stderr}"

    def cancel(self, handle: submitit.Job[None]) -> None:
        """End a job at once."""
        handle.cancel(check=False)

    def close(self) -> None:
        """Wait for processes that have said their last word to end."""
        until = time.monotonic() + _CHILDREN_SECONDS
        while time.monotonic() < until and not all(one.done() for one in self._children):
            time.sleep(_POLL_SECONDS)


def _start_ray() -> ModuleType:
    """Start Ray on this machine alone, with a token that only this study knows."""
    # Without this, it listens on all networks, whatever address it is given.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    # Otherwise Ray writes ~/.ray/auth_token, and each later `ray start` demands it.
    if not {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys():
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    telemetry.switch_off()
    import ray

    ray.init(
        address="local",  # even where a cluster already runs on this machine
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
        object_store_memory=_RAY_STORE_BYTES,  # runs exchange files, not objects
    )
    return ray


def _join_ray(address: str) -> ModuleType:
    """Join a cluster; asked first whether it is there, because Ray would wait for minutes.

    Raises:
        ConfigError: If it is not there.
    """
    import ray

    host, _, port = address.rpartition(":")
    is_open = False
    try:
        if host and port.isdigit():
            socket.create_connection((host, int(port)), timeout=10).close()
            is_open = True
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError, ray.exceptions.AuthenticationError) as error:
        if is_open or isinstance(error, ray.exceptions.AuthenticationError):
            reason = _why_refused(os.environ.get("RAY_AUTH_MODE", ""))
        else:
            reason = f"no Ray cluster answers ({first_line(error)})"
        raise ConfigError(f"hydra.launcher.address={address}: {reason}.") from error
    return ray


def _why_refused(mode: str) -> str:
    """Return why a cluster whose port is open rejects us, and what to do."""
    if mode.lower() != "token":
        return (
            "something answers there but does not let us join; a cluster with a token requires "
            "`export RAY_AUTH_MODE=token` here and its head's ~/.ray/auth_token"
        )
    return (
        "something answers there but does not let us join with the token of this machine; copy "
        "~/.ray/auth_token from the cluster's head to here"
    )


def _require(package: str, extra: str, purpose: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise MissingDependencyError(package, extra, purpose)
