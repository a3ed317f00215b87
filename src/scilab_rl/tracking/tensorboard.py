"""TensorBoard: event files in the run's directory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from scilab_rl.results import RunResult
from scilab_rl.tracking.base import RemoteState, SyncableTracker, TrackedRun


class TensorBoardTracker(SyncableTracker):
    """Writes scalars; read them with ``tensorboard --logdir data``."""

    def __init__(self) -> None:
        self._writer: Any = None

    def begin(self, run: TrackedRun) -> None:
        """Open the event file."""
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(_folder(run)))

    def remote_state(self, run: TrackedRun, names: Iterable[str], result: RunResult) -> RemoteState:
        """Read the event files."""
        if not _folder(run).is_dir():
            return RemoteState({})
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator(str(_folder(run)), size_guidance={"scalars": 0}).Reload()
        known = events.Tags()["scalars"]
        return RemoteState({n: {e.step for e in events.Scalars(n)} for n in names if n in known})

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def end(self, result: RunResult) -> None:
        """Close the event file."""
        self._writer.close()


def _folder(run: TrackedRun) -> Path:
    return run.run_dir / "tensorboard"
