"""Telling a tracker afterwards what it has missed of a run: it was away, or switched off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from scilab_rl.results import RunResult
from scilab_rl.tracking.base import SyncableTracker, TrackedRun

_NO_METRICS = ("kind", "epoch", "step")


def sync(
    tracker: SyncableTracker,
    run: TrackedRun,
    epochs: Sequence[Mapping[str, float]],
    files: Sequence[Path],
    result: RunResult,
) -> tuple[int, int] | None:
    """Send what is missing; what is there already is neither sent again nor changed.

    Args:
        tracker: The tracker, not begun.
        run: The run, as at its beginning.
        epochs: The run's rows of ``metrics.jsonl`` that describe epochs.
        files: Its videos and pages.
        result: How it ended.

    Returns:
        How many values and files have been sent, or None if nothing was missing.
    """
    values = [{n: v for n, v in row.items() if n not in _NO_METRICS} for row in epochs]
    remote = tracker.remote_state(run, {name for row in values for name in row}, result)
    missing = []
    for row, metrics in zip(epochs, values, strict=True):
        new = {n: v for n, v in metrics.items() if row["step"] not in remote.steps.get(n, ())}
        if new:
            missing.append((row, new))
    unsent = [p for p in files if remote.files is not None and p.name not in remote.files]
    if remote.is_closed and not missing and not unsent:
        return None
    tracker.begin(run)
    for row, new in missing:
        tracker.epoch(int(row["step"]), int(row["epoch"]), new)
    for path in unsent:
        tracker.artifact(path)
    tracker.end(result)
    return sum(len(new) for _, new in missing), len(unsent)
