"""The progress of a training in a notebook: one bar, and the metrics of the last epoch."""

from __future__ import annotations

import html
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from scilab_rl.tracking.console import SHOWN
from scilab_rl.training.callbacks import RunCallback

if TYPE_CHECKING:
    from scilab_rl.training.loop import Trainer

_REFRESH_SECONDS = 0.5


class NotebookProgress(RunCallback):
    """Shows a bar that is drawn again while the training goes on."""

    def __init__(self) -> None:
        super().__init__()
        self._handle: Any = None
        self._title, self._n_steps, self._newest = "", 1, ""
        self._next_refresh = 0.0

    def begin(self, trainer: Trainer) -> None:
        """Show the empty bar."""
        from IPython.display import display

        cfg = trainer.cfg
        self._title = f"{cfg.algorithm.name} learns {cfg.env} (seed {cfg.seed})"
        self._n_steps = cfg.total_steps
        self._handle = display(self, display_id=True)

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Show the metrics of the epoch."""
        shown = [f"{label} {values[name]:.3g}" for name, label in SHOWN if name in values]
        self._newest = f"epoch {epoch}: {', '.join(shown)}"
        self._handle.update(self)

    def close(self) -> None:
        """Show how it ended."""
        if self._handle is not None:
            self._handle.update(self)

    def _on_step(self) -> bool:
        if time.monotonic() >= self._next_refresh:
            self._next_refresh = time.monotonic() + _REFRESH_SECONDS
            self._handle.update(self)
        return True

    def __repr__(self) -> str:
        return f"{self._title}: {self.num_timesteps:,} of {self._n_steps:,} steps. {self._newest}"

    def _repr_html_(self) -> str:
        bar = f"<progress value='{self.num_timesteps}' max='{self._n_steps}'></progress>"
        return f"{bar} {html.escape(repr(self))}"
