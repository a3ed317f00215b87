"""Lets Hydra find our launchers; what they do is in `scilab_rl.parallel`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.utils import JobReturn, JobStatus

_log = logging.getLogger("scilab_rl")


class LocalLauncher(BasicLauncher):
    """Trains here, also where a file has the keys of another launcher.

    Args:
        settings: The mapping ``hydra.launcher``.
    """

    def __init__(self, **settings: object) -> None:
        super().__init__()
        if ignored := [key for key in settings if key != "kind"]:
            _log.info("hydra/launcher=local trains here and ignores %s.", ", ".join(ignored))


class JobLauncher(BasicLauncher):
    """Trains each run as a job of a scheduler. A study uses its settings only.

    Args:
        settings: The mapping ``hydra.launcher``.
    """

    def __init__(self, **settings: object) -> None:
        super().__init__()
        self.settings = settings

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Train the runs of a grid, each one once."""
        from scilab_rl.parallel import grid

        assert self.config is not None
        hydra = self.config.hydra
        launcher = {"_target_": hydra.launcher._target_, **self.settings}
        grid.run(launcher, job_overrides, hydra.sweeper.n_jobs, Path(hydra.sweep.dir))
        return [JobReturn(_return_value=None, status=JobStatus.COMPLETED) for _ in job_overrides]
