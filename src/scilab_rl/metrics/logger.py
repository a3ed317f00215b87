"""The logger that algorithms record to.

It has the interface of Stable-Baselines3's ``Logger``, so that any of its algorithms takes it
through ``set_logger``, and none of its dependencies.
"""

from __future__ import annotations

import logging
import math
import numbers
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

from scilab_rl.errors import AlgorithmError

TAKEN_NAMES = ("epoch", "step", "kind")  # of the columns that describe a row
_log = logging.getLogger("scilab_rl.algorithm")


class MetricLogger:
    """Collects the values of the current epoch until the framework takes them.

    Algorithms write ``self.logger.record("train/critic_loss", value)``; the newest value counts.
    ``record_mean`` averages over the epoch.

    Attributes:
        name_to_value: The values recorded since the last ``take``.
    """

    def __init__(self) -> None:
        self.name_to_value: dict[str, object] = {}
        self._sums: dict[str, float] = defaultdict(float)
        self._counts: dict[str, float] = defaultdict(float)
        self._watched: frozenset[str] = frozenset()
        self._seen: dict[str, float] = {}

    def record(self, key: str, value: object, exclude: object = None) -> None:
        """Record a value; an earlier one of the same epoch is replaced.

        Args:
            key: ``section/name``, for example ``train/target_critic_variance``.
            value: A number, or a tensor or array with one element.
            exclude: Accepted for Stable-Baselines3, ignored.
        """
        self.name_to_value[key] = value
        if key in self._watched:
            self._see(key, value)

    def record_lazy(self, key: str, function: Callable[[], object]) -> None:
        """Record a value that is shown next to the scene and is too expensive for every step.

        Args:
            key: ``section/name``.
            function: Returns the value; called only while this key is watched.
        """
        if key in self._watched:
            self._see(key, function())

    def record_mean(self, key: str, value: float | None, exclude: object = None) -> None:
        """Record a value that is averaged over the epoch."""
        if value is None:
            return
        self._sums[key] += value
        self._counts[key] += 1
        self.name_to_value[key] = self._sums[key] / self._counts[key]
        if key in self._watched:
            self._see(key, value)

    def watch(self, keys: Iterable[str]) -> None:
        """Remember the values of these keys, step by step; no keys: stop."""
        self._watched = frozenset(keys)
        self._seen = {}

    def take_seen(self) -> dict[str, float]:
        """Return the values of the watched keys that were recorded since the last call."""
        seen, self._seen = self._seen, {}
        return seen

    def take(self) -> dict[str, float]:
        """Return the numbers of this epoch and begin the next one.

        What is not a number (text, images, histograms of other frameworks) is left out.

        Raises:
            AlgorithmError: If a metric has the name of a column that is there anyway.
        """
        for name in TAKEN_NAMES:
            if name in self.name_to_value:
                raise AlgorithmError(
                    f"The algorithm records '{name}', which is a column of metrics.csv already: "
                    f"give it a section, as in train/{name}."
                )
        values = self._numbers()
        self.name_to_value.clear()
        self._sums.clear()
        self._counts.clear()
        return values

    def _see(self, key: str, value: object) -> None:
        number = as_number(value)
        if number is not None and math.isfinite(number):
            self._seen[key] = number

    def _numbers(self) -> dict[str, float]:
        return {
            key: number
            for key, value in self.name_to_value.items()
            if (number := as_number(value)) is not None
        }

    def state(self) -> dict[str, dict[str, float]]:
        """Return what was recorded in the unfinished epoch, for a checkpoint."""
        return {
            "values": self._numbers(),
            "sums": dict(self._sums),
            "counts": dict(self._counts),
        }

    def set_state(self, state: dict[str, dict[str, float]]) -> None:
        """Go on with an unfinished epoch."""
        self.name_to_value = dict(state["values"])
        self._sums = defaultdict(float, state["sums"])
        self._counts = defaultdict(float, state["counts"])

    def dump(self, step: int = 0) -> None:
        """Do nothing: the framework decides when an epoch ends, not the algorithm."""

    def log(self, *args: object, level: int = logging.INFO) -> None:
        """Write a message of the algorithm to the log of the run."""
        _log.log(level, " ".join(str(arg) for arg in args))

    def debug(self, *args: object) -> None:
        """Write a message of the lowest level."""
        self.log(*args, level=logging.DEBUG)

    def info(self, *args: object) -> None:
        """Write an ordinary message."""
        self.log(*args)

    def warn(self, *args: object) -> None:
        """Write a warning."""
        self.log(*args, level=logging.WARNING)

    def error(self, *args: object) -> None:
        """Write an error."""
        self.log(*args, level=logging.ERROR)

    def set_level(self, level: int) -> None:
        """Set the level of the messages; metrics are not affected."""
        _log.setLevel(level)

    def get_dir(self) -> None:
        """Return None: the run owns its directory."""

    def close(self) -> None:
        """Do nothing: trackers are closed by the run."""


def as_number(value: Any) -> float | None:
    """Return a plain float for anything that holds exactly one number, otherwise None."""
    if isinstance(value, numbers.Real):
        return float(value)
    if getattr(value, "size", None) == 1 or getattr(value, "numel", lambda: 0)() == 1:
        item = value.item()
        return float(item) if isinstance(item, numbers.Real) else None
    return None
