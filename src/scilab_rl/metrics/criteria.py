"""When to stop and how good a run was: pure functions of the metric history."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.metrics.store import MetricStore

_FALLBACK_CRITERION = "eval/mean_reward"


def should_stop_early(series: Sequence[float], threshold: float, last_n: int) -> bool:
    """Return whether the mean of the last ``last_n`` values has reached the threshold.

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
    """Return the last value of the criterion; None if it was never measured or is not a number."""
    value = store.latest(criterion)
    return value if value is not None and math.isfinite(value) else None


def is_better(candidate: tuple[float, ...], best: tuple[float, ...] | None) -> bool:
    """Return whether a policy beats the best one so far, compared element by element.

    Args:
        candidate: For example ``(success_rate, mean_reward)``.
        best: The same of the best policy, or None if there is none yet.
    """
    return best is None or candidate > best


def criterion_of(values: Mapping[str, float], criterion: str) -> float:
    """Return the criterion in one evaluation; tasks without success are judged by reward.

    Raises:
        ConfigError: If the evaluation does not have it.
    """
    if criterion not in values and criterion.startswith("eval/success"):
        criterion = _FALLBACK_CRITERION
    if criterion not in values:
        raise ConfigError(
            f"hyperopt_criterion: the run records no '{criterion}'."
            f"{did_you_mean(criterion, values)}"
        )
    return float(values[criterion])


def criterion_curve(rows: Sequence[Mapping[str, float]], criterion: str) -> list[float]:
    """Return the criterion in all evaluations of a run, in one unit.

    A task that reports success only when it succeeds has no success rate before; there it is 0.

    Raises:
        ConfigError: If an evaluation does not have it.
    """
    if criterion.startswith("eval/success") and any(criterion in row for row in rows):
        return [float(row.get(criterion, 0.0)) for row in rows]
    return [criterion_of(row, criterion) for row in rows]


def run_score(store: MetricStore, criterion: str) -> float | None:
    """Return the run's score; tasks without a notion of success are scored by reward."""
    value = final_score(store, criterion)
    if value is None and criterion.startswith("eval/success"):
        return final_score(store, _FALLBACK_CRITERION)
    return value
