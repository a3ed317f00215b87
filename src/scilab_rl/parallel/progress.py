"""Progress of many runs: a line for each that ends, and on a terminal the state of all below."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from scilab_rl.tracking.console import is_interactive

_MINUTES = 90.0  # from so many seconds on, minutes are shown


class Progress:
    """Writes lines to standard error and, on a terminal, keeps the newest state below them."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._live: Live | None = None

    def __enter__(self) -> Progress:
        if is_interactive():
            self._live = Live(console=Console(stderr=True), transient=True, refresh_per_second=2)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    @property
    def seconds(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self._started

    def say(self, line: str) -> None:
        """Write a line that stays."""
        if self._live is not None:
            self._live.console.print(line, highlight=False, markup=False)
        else:
            sys.stderr.write(line + "\n")
            sys.stderr.flush()

    def show(self, lines: Sequence[str]) -> None:
        """Replace the state below the lines; without a terminal, nothing happens."""
        if self._live is not None:
            self._live.update(Group(*map(Text, lines)))


def time_left(seconds: float, done: float, left: float) -> str:
    """Return how long the rest takes at the speed so far.

    Args:
        seconds: Seconds since the beginning.
        done: What has been done since, in any unit.
        left: What is left, in the same unit.

    >>> time_left(600, 2, 4), time_left(50, 5, 4), time_left(50, 0, 4), time_left(50, 3, 0)
    ('about 20 min left', 'about 40 s left', 'time left not known yet', 'last runs')
    """
    if left <= 0:
        return "last runs"
    if done <= 0:
        return "time left not known yet"
    rest = seconds / done * left
    return f"about {rest:.0f} s left" if rest < _MINUTES else f"about {rest / 60:.0f} min left"
