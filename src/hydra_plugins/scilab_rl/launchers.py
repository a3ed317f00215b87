"""Lets Hydra find our launchers; what they do is in `scilab_rl.hyperopt`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.utils import JobReturn, JobStatus


class JobLauncher(BasicLauncher):
    """Trains each run as a job of a scheduler. A study uses its settings only.

    Args:
        settings: The mapping ``hydra.launcher``.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__()
        self.settings = settings

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Train the runs of a grid, each one once."""
        from scilab_rl.hyperopt import grid

        assert self.config is not None
        target = self.config.hydra.launcher._target_
        grid.run({"_target_": target, **self.settings}, job_overrides, self.config)
        return [JobReturn(_return_value=None, status=JobStatus.COMPLETED) for _ in job_overrides]
