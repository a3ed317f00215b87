"""What the charts of pages are drawn from: series, intervals and axes.

The markup is that of ``templates/macros.html``. Curves are drawn into a square of 100 x 100 that
the browser stretches to the room there is; letters and marks are not stretched.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeGuard

from scilab_rl.drawing import COLORS, number_text, ticks

Numbers = Sequence[float | None]
_ROOM = 0.05  # of the range, above and below the values
_THOUSANDS = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
# Matplotlib's viridis, which is even to the eye and safe for color-blind readers, at 9 places.
_VIRIDIS = (
    "#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30",
    "#fde725",
)  # fmt: skip


@dataclass(frozen=True)
class Series:
    """The curves of one thing, in one color.

    Attributes:
        name: In the legend.
        lines: Thin lines, for example one per seed, as x and y; each point gets a mark.
        mean: The thick line, as x and y.
        band: Around it, as x, lower and upper end.
        points: Marks without a line, as x and y.
        color: Its number in the palette, see `color_variable`.
    """

    name: str
    lines: Sequence[tuple[Sequence[float], Numbers]] = ()
    mean: tuple[Sequence[float], Numbers] | None = None
    band: tuple[Sequence[float], Sequence[float], Sequence[float]] | None = None
    color: int = 0
    points: tuple[Sequence[float], Numbers] | None = None

    @property
    def xs(self) -> list[float]:
        """All places on the horizontal axis."""
        return [x for xs, _ in self._drawn for x in xs]

    @property
    def ys(self) -> list[float]:
        """All values that are drawn."""
        values = [y for _, ys in self._drawn for y in ys if _is_number(y)]
        return values + [y for ends in (self.band or ())[1:] for y in ends]

    @property
    def _drawn(self) -> list[tuple[Sequence[float], Numbers]]:
        return [*self.lines, *(one for one in (self.mean, self.points) if one is not None)]


@dataclass(frozen=True)
class Interval:
    """A row of a forest plot, or a point of a reliability curve.

    Attributes:
        label: What it is about.
        value: The estimate.
        low: The lower end of its interval.
        high: The upper end.
        points: Single values, drawn as faint marks.
        text: Written next to it; the numbers, if empty.
        color: Its number in the palette.
        link: Address that the label leads to.
        at: Where it lies, for a reliability curve: the predicted probability.
        n: How many values it is computed from.
    """

    label: str
    value: float
    low: float
    high: float
    points: Sequence[float] = ()
    text: str = ""
    color: int = 0
    link: str = ""
    at: float = 0.0
    n: int = 0


@dataclass(frozen=True)
class Axis:
    """A range of numbers on a side of 100.

    Attributes:
        low: Its first number.
        high: Its last number, larger than the first.
        log: Whether distances are ratios.
    """

    low: float
    high: float
    log: bool = False

    def at(self, number: float) -> float:
        """Return the place of a number, 0 at ``low`` and 100 at ``high``.

        >>> Axis(0, 2).at(0.5), Axis(1, 100, log=True).at(10)
        (25.0, 50.0)
        """
        low, high, value = self.low, self.high, number
        if self.log:
            low, high, value = math.log10(low), math.log10(high), math.log10(max(number, self.low))
        return round(100 * (value - low) / (high - low), 3)

    def ticks(self, n: int = 5) -> list[tuple[float, str]]:
        """Return places and texts of about ``n`` round numbers."""
        if not self.log:
            return [(self.at(tick), short_number(tick)) for tick in ticks(self.low, self.high, n)]
        first, last = math.ceil(math.log10(self.low)), math.floor(math.log10(self.high))
        every = max(1, round((last - first + 1) / n))
        powers = [10.0**power for power in range(first, last + 1, every)]
        return [(self.at(power), short_number(power)) for power in powers]


def axis(
    numbers: Iterable[float | None],
    wanted: tuple[float, float] | None = None,
    *,
    log: bool = False,
    tight: bool = False,
) -> Axis:
    """Return an axis that holds all numbers.

    Args:
        numbers: Missing ones are ignored.
        wanted: The range, if it does not depend on the numbers; rates have 0 to 1.
        log: Whether distances are ratios; numbers that are not positive are ignored.
        tight: Whether the axis ends at the numbers.

    >>> axis([0, None, 10], tight=True)
    Axis(low=0, high=10, log=False)
    """
    if wanted is not None:
        return Axis(*wanted, log=log)
    known = [n for n in numbers if _is_number(n) and (n > 0 or not log)]
    if not known:
        return Axis(1, 10, log=True) if log else Axis(0, 1)
    low, high = min(known), max(known)
    if log:
        room = (high / low) ** _ROOM if high > low else 2.0
        return Axis(low / room, high * room, log=True)
    if low == high:
        low, high = low - (abs(low) or 1) * 0.1, high + (abs(high) or 1) * 0.1
    room = 0 if tight else _ROOM * (high - low)
    return Axis(low - room, high + room)


def path(xs: Sequence[float], ys: Numbers, x: Axis, y: Axis) -> str:
    """Return a curve as the data of an SVG path; missing values are gaps.

    >>> path([0, 1, 2], [0, None, 2], Axis(0, 2), Axis(0, 2))
    'M0.0 100.0M100.0 0.0'
    """
    parts, pen = [], "M"
    for place, value in zip(xs, ys, strict=True):
        if not _is_number(value):
            pen = "M"
            continue
        parts.append(f"{pen}{x.at(place)} {round(100 - y.at(value), 3)}")
        pen = "L"
    return "".join(parts)


def dots(xs: Sequence[float], ys: Numbers, x: Axis, y: Axis) -> str:
    """Return a mark at each value, as the data of an SVG path with round ends."""
    known = [(a, b) for a, b in zip(xs, ys, strict=True) if _is_number(b)]
    return "".join(f"M{x.at(a)} {round(100 - y.at(b), 3)}h.01" for a, b in known)


def area(xs: Sequence[float], low: Sequence[float], high: Sequence[float], x: Axis, y: Axis) -> str:
    """Return the outline of a band as the data of an SVG path."""
    back = path([*reversed(xs)], [*reversed(low)], x, y)
    return f"{path(xs, high, x, y)}L{back[1:]}Z" if back else ""


def short_number(number: float) -> str:
    """Return a number in few characters, for an axis.

    >>> [short_number(n) for n in (200_000, 1_500_000, 0.25, -0.0, 1e-05)]
    ['200k', '1.5M', '0.25', '0', '1e-05']
    """
    for size, letter in _THOUSANDS:
        if abs(number) >= size:
            return f"{number / size:.4g}{letter}"
    return number_text(number) if number else "0"


def color_variable(number: int) -> str:
    """Return a color of the palette for a style sheet, which has it for light and dark pages.

    >>> color_variable(9)
    'var(--c1)'
    """
    return f"var(--c{number % len(COLORS)})"


def heat_color(share: float | None) -> str:
    """Return the color of a share from 0 to 1 in a heat map; gray where there is none.

    >>> heat_color(0.0), heat_color(1.0), heat_color(None)
    ('#440154', '#fde725', '#a1a1aa')
    """
    if not _is_number(share):
        return "#a1a1aa"
    place = min(max(share, 0.0), 1.0) * (len(_VIRIDIS) - 1)
    index = min(int(place), len(_VIRIDIS) - 2)
    after = place - index
    first, second = (
        [int(_VIRIDIS[k][i : i + 2], 16) for i in (1, 3, 5)] for k in (index, index + 1)
    )
    mixed = [round(a * (1 - after) + b * after) for a, b in zip(first, second, strict=True)]
    return "#" + "".join(f"{part:02x}" for part in mixed)


def _is_number(value: float | None) -> TypeGuard[float]:
    return value is not None and math.isfinite(value)
