"""Lets Hydra find our sweeper: for performance tests, studies, and plain grids as Hydra's own."""

from __future__ import annotations

from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf


class StudySweeper(BasicSweeper):
    """Runs a multirun as a performance test, as a study when it searches, as a grid when it lists.

    Args:
        settings: The mapping ``hydra.sweeper``.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(max_batch_size=None, params=settings.get("params"))

    def sweep(self, arguments: list[str]) -> Any:
        """Run all trials."""
        from scilab_rl.acceptance import session
        from scilab_rl.config.schema import CONDITIONS
        from scilab_rl.search import parsing, sweep

        assert self.config is not None and self.hydra_context is not None
        sweeper = OmegaConf.to_container(self.config.hydra.sweeper, resolve=True)
        launcher = OmegaConf.to_container(self.config.hydra.launcher, resolve=True)
        assert isinstance(sweeper, dict) and isinstance(launcher, dict)
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = parser.parse_overrides([*self._parse_config(), *arguments])
        if CONDITIONS in self.config:
            return session.run_from_sweep(sweeper, launcher, overrides)
        if sweep.is_study(sweeper, overrides):
            return sweep.run_study(sweeper, launcher, overrides)
        parsing.refuse_endless_grid(overrides)
        return super().sweep(arguments)
