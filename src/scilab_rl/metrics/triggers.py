"""When to keep a scene: ``critic_variance > p99``, ``success``, ``custom_probes.surprise > 0``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.metrics.probes import Curve

EVENTS = ("success", "success lost", "object fell")
_COMPARISON = re.compile(
    r"^\s*(?P<metric>[^<>\s]+)\s*(?P<sign>[<>])\s*(?P<limit>p?-?[\d.eE+-]+)\s*$"
)


@dataclass(frozen=True)
class Trigger:
    """A condition on a scene.

    Attributes:
        text: As the user wrote it.
        metric: The metric that is compared, or None for an event.
        sign: ``<`` or ``>``.
        limit: A number, or a percentile of all values seen so far.
        is_percentile: Whether ``limit`` is a percentile.
    """

    text: str
    metric: str | None = None
    sign: str = ">"
    limit: float = 0.0
    is_percentile: bool = False

    def score(
        self, values: Mapping[Curve, float], events: Iterable[str], seen: np.ndarray
    ) -> float | None:
        """Return how strongly a scene meets the condition, or None when it does not.

        Args:
            values: The curves of the scene.
            events: What can be seen in it.
            seen: All values of the metric so far. Shapes: ``(n,)``.
        """
        if self.metric is None:
            return 1.0 if self.text in events else None
        if Curve(self.metric) not in values or not len(seen):
            return None
        limit = float(np.percentile(seen, self.limit)) if self.is_percentile else self.limit
        excess = values[Curve(self.metric)] - limit
        excess = excess if self.sign == ">" else -excess
        return excess if excess > 0 else None


def parse_trigger(text: str) -> Trigger:
    """Return the condition that a text describes.

    >>> parse_trigger("critic_variance > p99").limit
    99.0

    Raises:
        ConfigError: If it is neither an event nor a comparison.
    """
    if text in EVENTS:
        return Trigger(text)
    found = _COMPARISON.match(text)
    try:
        if found is None:
            raise ValueError
        limit = found["limit"]
        number = float(limit.removeprefix("p"))
        if limit.startswith("p") and not 0 <= number <= 100:
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"record_when: '{text}' is not a condition.{did_you_mean(text, EVENTS)} Write "
            f"'METRIC > NUMBER', 'METRIC > p99' (percentile), or one of: {', '.join(EVENTS)}."
        ) from None
    return Trigger(text, found["metric"], found["sign"], number, limit.startswith("p"))
