"""The history of all metrics of a run: the only truth for early stopping, scores and tables."""

from __future__ import annotations

from collections.abc import Mapping

Row = dict[str, float]


class MetricStore:
    """An append-only list of rows, one per epoch.

    Example:
        >>> store = MetricStore()
        >>> store.append(2000, {"eval/success_rate": 0.4})
        >>> store.append(4000, {"eval/success_rate": 0.9, "train/critic_loss": 0.1})
        >>> store.series("eval/success_rate")
        [0.4, 0.9]
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.rows: list[Row] = []

    def __len__(self) -> int:
        return len(self.rows)

    def append(self, step: int, values: Mapping[str, float]) -> None:
        """Add the row of one epoch.

        Args:
            step: Environment steps so far.
            values: Metric name to value.
        """
        self.steps.append(step)
        self.rows.append(dict(values))

    def series(self, name: str) -> list[float]:
        """Return the values of one metric, oldest first, without the epochs that lack it."""
        return [row[name] for row in self.rows if name in row]

    def latest(self, name: str) -> float | None:
        """Return the newest value of a metric, or None when it was never recorded."""
        series = self.series(name)
        return series[-1] if series else None
