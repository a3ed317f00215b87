"""Drawing curves beside a scene, quickly: all is drawn once and then uncovered step by step."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scilab_rl.visualization.records import Clip, title_of, value_range

COLOURS = (
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
_ROWS = 4  # panels in one column, until there are four columns
_MIN_PANEL_HEIGHT = 112
NO_VALUE = "-"  # the font has no dash
_SMOOTH = 2  # everything that does not move is drawn twice as large and scaled down
_TITLE, _LEFT, _RIGHT, _BOTTOM = 22, 50, 12, 18  # pixels around the curves


def grid(n_panels: int) -> tuple[int, int]:
    """Return rows and columns for a number of panels; none is left out.

    >>> [grid(n) for n in (1, 3, 4, 5, 7, 9, 11, 16, 20)]
    [(1, 1), (3, 1), (4, 1), (3, 2), (4, 2), (3, 3), (4, 3), (4, 4), (5, 4)]
    """
    columns = min(math.ceil(n_panels / _ROWS), _ROWS)
    return math.ceil(n_panels / columns), columns


def sheet_height(n_panels: int, at_least: int) -> int:
    """Return the height in pixels that the panels need."""
    return max(at_least, grid(n_panels)[0] * _MIN_PANEL_HEIGHT)


def number_text(number: float) -> str:
    """Return a number in few characters.

    >>> number_text(-12.3456), number_text(0.00001234), number_text(3.0)
    ('-12.35', '1.23e-05', '3')
    """
    return f"{number:.4g}" if abs(number) >= 1e-3 else f"{number:.3g}"


@dataclass(frozen=True)
class _Panel:
    """Where a panel lies and what it shows; pixels on the finished sheet."""

    name: str
    curves: dict[str, list[float | None]]
    left: int
    top: int
    right: int
    bottom: int
    low: float
    high: float

    def y(self, number: float) -> float:
        """Return the height of a number on the sheet."""
        share = (number - self.low) / (self.high - self.low)
        return self.bottom - share * (self.bottom - self.top)


class PanelSheet:
    """The panels of a clip, drawn up to any of its scenes.

    Ranges are those of the whole clip, so that nothing jumps.

    Args:
        clip: The finished clip.
        width: Pixels of one column.
        height: Pixels of the sheet.
    """

    def __init__(self, clip: Clip, width: int, height: int) -> None:
        names = clip.info.panels
        rows, columns = grid(len(names))
        self.size = (columns * width, height)
        self.n = len(clip.records)
        self.breaks = {i for i in range(1, self.n) if clip.records[i].step == 0}
        self.panels = [
            self._place(clip, name, index, rows, width) for index, name in enumerate(names)
        ]
        self._empty = self._drawn(with_curves=False)
        self._full = self._drawn(with_curves=True)

    def until(self, index: int) -> Any:
        """Return the sheet as a Pillow image, with curves up to this scene."""
        from PIL import Image, ImageDraw

        pixels = self._empty.copy()
        for panel in self.panels:
            x = round(self._x(panel, index)) + 1
            area = np.s_[panel.top - 4 : panel.bottom + 4, panel.left - 3 : x]
            pixels[area] = self._full[area]
        image = Image.fromarray(pixels)
        draw = ImageDraw.Draw(image)
        for panel in self.panels:
            self._draw_cursor(draw, panel, index)
        return image

    def _place(self, clip: Clip, name: str, index: int, rows: int, width: int) -> _Panel:
        column, row = divmod(index, rows)
        height = self.size[1] / rows
        curves = clip.curves(name)
        low, high = value_range(list(curves.values()))
        return _Panel(
            name,
            curves,
            left=column * width + _LEFT,
            top=round(row * height) + _TITLE,
            right=(column + 1) * width - _RIGHT,
            bottom=round((row + 1) * height) - _BOTTOM,
            low=low,
            high=high,
        )

    def _x(self, panel: _Panel, index: int) -> float:
        return panel.left + index / max(self.n - 1, 1) * (panel.right - panel.left)

    def _drawn(self, *, with_curves: bool) -> np.ndarray:
        from PIL import Image, ImageDraw

        width, height = self.size
        image = Image.new("RGB", (width * _SMOOTH, height * _SMOOTH), BACKGROUND)
        draw = ImageDraw.Draw(image)
        for panel in self.panels:
            self._draw_axes(draw, panel)
            if with_curves:
                self._draw_curves(draw, panel)
        return np.asarray(image.resize(self.size, Image.Resampling.LANCZOS))

    def _draw_axes(self, draw: Any, panel: _Panel) -> None:
        big = _big
        draw.text(
            big(panel.left - _LEFT + 12, panel.top - _TITLE / 2 - 1),
            _shortened(title_of(panel.name), 30),
            fill=INK,
            font=_font(13 * _SMOOTH),
            anchor="lm",
        )
        small = _font(10 * _SMOOTH)
        for tick in ticks(panel.low, panel.high, 3):
            y = panel.y(tick)
            draw.line([big(panel.left, y), big(panel.right, y)], fill=GRID, width=_SMOOTH)
            where = big(panel.left - 6, y)
            draw.text(where, number_text(tick), fill=FAINT, font=small, anchor="rm")
        for tick in ticks(0, max(self.n - 1, 1), 5):
            if tick == int(tick):
                where = big(self._x(panel, int(tick)), panel.bottom + 5)
                draw.text(where, str(int(tick)), fill=FAINT, font=small, anchor="mt")
        for index in self.breaks:
            x = self._x(panel, index)
            draw.line([big(x, panel.top), big(x, panel.bottom)], fill=FRAME, width=_SMOOTH)
        corner = [big(panel.left, panel.top), big(panel.left, panel.bottom)]
        draw.line([*corner, big(panel.right, panel.bottom)], fill=FRAME, width=_SMOOTH)

    def _draw_curves(self, draw: Any, panel: _Panel) -> None:
        for number, curve in enumerate(panel.curves.values()):
            colour = COLOURS[number % len(COLOURS)]
            for start, values in self._segments(curve):
                points = [
                    _big(self._x(panel, start + offset), panel.y(value))
                    for offset, value in enumerate(values)
                ]
                if len(points) > 1:
                    draw.line(points, fill=colour, width=round(1.6 * _SMOOTH), joint="curve")
                else:
                    draw.circle(points[0], 1.8 * _SMOOTH, fill=colour)

    def _segments(self, curve: Sequence[float | None]) -> Iterator[tuple[int, list[float]]]:
        """Yield runs of numbers without gap and episode boundary, each with its first scene."""
        start = 0
        run: list[float] = []
        for index, value in enumerate(curve):
            if run and (value is None or index in self.breaks):
                yield start, run
                run = []
            if value is not None:
                if not run:
                    start = index
                run.append(value)
        if run:
            yield start, run

    def _draw_cursor(self, draw: Any, panel: _Panel, index: int) -> None:
        x = self._x(panel, index)
        draw.line([(x, panel.top), (x, panel.bottom)], fill="#a1a1aa", width=1)
        written = panel.right
        for number, (label, curve) in reversed(list(enumerate(panel.curves.items()))):
            value, colour = curve[index], COLOURS[number % len(COLOURS)]
            if value is not None:
                draw.circle((x, panel.y(value)), 3, fill=colour, outline=BACKGROUND)
            text = NO_VALUE if value is None else number_text(value)
            if label and len(panel.curves) <= 4:
                text = f"{label}: {text}"
            written = self._write_value(draw, panel, text, colour, written)

    @staticmethod
    def _write_value(draw: Any, panel: _Panel, text: str, colour: str, right: int) -> int:
        """Write a current value left of the last one; return where the next one may end."""
        font = _font(12)
        width = draw.textlength(text, font=font)
        if right - width < panel.left + 9 * min(len(title_of(panel.name)), 30) - _LEFT + 12:
            return 0
        where = (right, panel.top - _TITLE / 2 - 1)
        draw.text(where, text, fill=colour, font=font, anchor="rm")
        return int(right - width - 10)


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


def _big(x: float, y: float) -> tuple[float, float]:
    return x * _SMOOTH, y * _SMOOTH


@functools.cache
def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"…{text[1 - length :]}"
