"""Colors, letters and ticks of all that is drawn, so that it looks as if of one hand."""

from __future__ import annotations

import functools
import math
from typing import Any

COLORS = (
    "#2563eb",
    "#ea580c",
    "#059669",
    "#9333ea",
    "#dc2626",
    "#0891b2",
    "#a16207",
    "#db2777",
)
BACKGROUND, FRAME, GRID, INK, FAINT = "#ffffff", "#d4d4d8", "#f1f1f4", "#18181b", "#71717a"
# Of goals, in every picture; in MuJoCo's scenes, the goal is red too.
ACHIEVED, DESIRED, REACHED = COLORS[0], COLORS[4], COLORS[2]
FAILED = COLORS[4]  # of outcomes; REACHED is their other color


@functools.cache
def font(size: int) -> Any:
    """Return letters of a height in pixels."""
    from PIL import ImageFont

    return ImageFont.load_default(size)


def number_text(number: float) -> str:
    """Return a number in few characters.

    >>> number_text(-12.3456), number_text(0.00001234), number_text(3.0)
    ('-12.35', '1.23e-05', '3')
    """
    return f"{number:.4g}" if abs(number) >= 1e-3 else f"{number:.3g}"


def ticks(low: float, high: float, n: int) -> list[float]:
    """Return about ``n`` round numbers inside a range.

    >>> ticks(0, 50, 5)
    [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    """
    step = 10 ** math.floor(math.log10((high - low) / n))
    step *= min((1, 2, 2.5, 5, 10), key=lambda factor: abs((high - low) / (step * factor) - n))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [float(f"{index * step:.12g}") for index in range(first, last + 1)]
