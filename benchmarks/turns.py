"""Fair comparisons on a machine whose load changes: taking turns, and intervals of the ratios."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

Result = TypeVar("Result")
N_BOOTSTRAPS = 10_000


class Seconds(NamedTuple):
    """How long something took, by the clock and in processor time."""

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> Seconds:
        """Return what the clocks of this process show."""
        return cls(time.perf_counter(), time.process_time())

    def __sub__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall - other.wall, self.cpu - other.cpu)


def take_turns(calls: Mapping[str, Callable[[], Result]], rounds: int) -> dict[str, list[Result]]:
    """Call all, forwards and then backwards (A B B A), and return what each call has returned."""
    results: dict[str, list[Result]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name in (*calls, *reversed(calls)):
            results[name].append(calls[name]())
    return results


def timed(call: Callable[[], Any]) -> Seconds:
    """Return how long a call takes; it may return processor time that another process took."""
    started = Seconds.now()
    elsewhere = call() or 0.0
    wall, cpu = Seconds.now() - started
    return Seconds(wall, cpu + elsewhere)


def relative(values: Sequence[float], base: Sequence[float]) -> dict[str, Any]:
    """Compare values with those of the same turns.

    Returns:
        ``ratio``: median of value / base over the turns; ``interval``: 95 % of its bootstrap.
    """
    ratios = np.array(values) / np.array(base)
    drawn = np.random.default_rng(0).integers(0, len(ratios), (N_BOOTSTRAPS, len(ratios)))
    low, high = np.percentile(np.median(ratios[drawn], axis=1), [2.5, 97.5])
    return {"ratio": float(np.median(ratios)), "interval": [float(low), float(high)]}


def publish(table: str, report: dict[str, Any], path: Path | None) -> None:
    """Print a table and a JSON object, and write the object to a file if there is one."""
    text = json.dumps(report | {"load_average": os.getloadavg()[0]}, indent=2)
    sys.stdout.write(f"{table}\n\n{text}\n")
    if path:
        path.write_text(text + "\n", encoding="utf-8")
