"""TensorBoard: event files in the run's directory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scilab_rl.results import RunResult
from scilab_rl.tracking.base import RunInfo, Tracker


class TensorBoardTracker(Tracker):
    """Writes scalars; read them with ``tensorboard --logdir data``."""

    def __init__(self) -> None:
        self._writer: Any = None

    def begin(self, run: RunInfo) -> None:
        """Open the event file."""
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(run.run_dir / "tensorboard"))

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def end(self, result: RunResult) -> None:
        """Close the event file."""
        self._writer.close()
