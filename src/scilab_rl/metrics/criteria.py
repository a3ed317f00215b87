"""When to stop and how good a run was: pure functions of the metric history."""

from __future__ import annotations

import math
from collections.abc import Sequence

from scilab_rl.metrics.store import MetricStore


def should_stop_early(series: Sequence[float], threshold: float, last_n: int) -> bool:
    """Tell whether the mean of the last ``last_n`` values has reached the threshold.

    Args:
        series: One value per epoch, oldest first.
        threshold: Value to reach.
        last_n: How many epochs to average, at least 1. Fewer values never stop a run.

    >>> should_stop_early([0.8, 0.9, 1.0], threshold=0.9, last_n=3)
    True
    >>> should_stop_early([1.0, 1.0], threshold=0.9, last_n=3)
    False
    """
    if len(series) < last_n:
        return False
    # fsum, because 3 * 0.9 summed naively is below 2.7
    return math.fsum(series[-last_n:]) / last_n >= threshold


def final_score(store: MetricStore, criterion: str) -> float | None:
    """Return the last value of the criterion; None when it was never measured or is no number."""
    value = store.latest(criterion)
    return value if value is not None and math.isfinite(value) else None


def is_better(candidate: tuple[float, ...], best: tuple[float, ...] | None) -> bool:
    """Tell whether a policy beats the best one so far, compared element by element.

    Args:
        candidate: For example ``(success_rate, mean_reward)``.
        best: The same of the best policy, or None when there is none yet.
    """
    return best is None or candidate > best
