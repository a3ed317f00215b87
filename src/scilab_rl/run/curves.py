"""Learning curves as PNG, as SVG and in the characters of a terminal, without a plotting library.

Importing one would take longer than the end of a short run; these take a few milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from scilab_rl import files
from scilab_rl.drawing import BACKGROUND, COLORS, FRAME, GRID, INK, font, number_text, ticks

CURVE_FILE = "curve.png"
SHOWN = ("eval/success_rate", "eval/mean_reward")
WIDTH, HEIGHT = 640, 360  # pixels of a chart
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 32, 38, 44
_LEGEND = 18  # pixels of a line of the legend
_SMOOTH = 2  # drawn twice as large and scaled down
_SOFT = "#52525b"
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))  # of Braille, by row and column
_LETTERS = "*+ox#%@&"


@dataclass(frozen=True)
class Curve:
    """One line of a chart.

    Attributes:
        steps: Environment steps, ascending.
        values: The metric at each. Shapes: as ``steps``.
        color: Number of its color; several lines may share one.
        label: For the legend; "": none.
        is_faint: Whether it is one of several runs, and drawn thin.
    """

    steps: Sequence[float]
    values: Sequence[float]
    color: int = 0
    label: str = ""
    is_faint: bool = False


@dataclass(frozen=True)
class Chart:
    """Curves over the same axes.

    Attributes:
        title: What is shown: the metric.
        curves: The curves, those on top last.
    """

    title: str
    curves: Sequence[Curve]
    low: float = field(init=False)
    high: float = field(init=False)
    end: float = field(init=False)

    def __post_init__(self) -> None:
        values = [value for curve in self.curves for value in curve.values]
        low, high = min(values, default=0.0), max(values, default=1.0)
        if self.title.partition("/")[2].startswith("success"):
            low, high = 0.0, 1.0
        margin = 0.0 if low < high else max(abs(low), 1.0) / 2
        end = max((curve.steps[-1] for curve in self.curves if len(curve.steps)), default=1)
        for name, value in (("low", low - margin), ("high", high + margin), ("end", end or 1)):
            object.__setattr__(self, name, value)

    def points(
        self, curve: Curve, left: float, top: float, right: float, bottom: float
    ) -> list[tuple[float, float]]:
        """Return the places of a curve's values in a rectangle."""
        across, down = (right - left) / self.end, (bottom - top) / (self.high - self.low)
        pairs = zip(curve.steps, curve.values, strict=True)
        return [(left + x * across, bottom - (y - self.low) * down) for x, y in pairs]


def series(rows: Sequence[Mapping[str, Any]], metric: str) -> tuple[list[float], list[float]]:
    """Return the steps at which a metric was measured, and its finite values."""
    measured = [
        (float(row["step"]), float(row[metric]))
        for row in rows
        if isinstance(row.get(metric), (int, float)) and math.isfinite(row[metric])
    ]
    return [step for step, _ in measured], [value for _, value in measured]


def write_run_curve(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw success and mean reward of a run; nothing is written when it was evaluated only once.

    Args:
        rows: One per evaluation, with ``step`` and metrics.
        path: The PNG.
    """
    charts = [Chart(m, [Curve(*found)]) for m in SHOWN if len((found := series(rows, m))[0]) > 1]
    if charts:
        write_png(charts, path)


def write_png(charts: Sequence[Chart], path: Path) -> None:
    """Write charts next to each other as PNG."""
    from PIL import Image, ImageDraw

    height = HEIGHT + _legend_height(charts)
    size = (WIDTH * len(charts) * _SMOOTH, height * _SMOOTH)
    image = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(image)
    for place, chart in enumerate(charts):
        for shape in _shapes(chart, place * WIDTH):
            _paint(draw, shape)
    image = image.resize((size[0] // _SMOOTH, size[1] // _SMOOTH), Image.Resampling.LANCZOS)
    files.atomic_write(path, lambda file: image.save(file, "PNG", optimize=True))


def write_svg(charts: Sequence[Chart], path: Path) -> None:
    """Write charts next to each other as SVG."""
    width, height = WIDTH * len(charts), HEIGHT + _legend_height(charts)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="{BACKGROUND}"/>',
    ]
    for place, chart in enumerate(charts):
        lines += map(_svg_element, _shapes(chart, place * WIDTH))
    files.write_text(path, "\n".join([*lines, "</svg>"]) + "\n")


def in_characters(
    chart: Chart, width: int, height: int, *, dots: bool
) -> list[list[tuple[str, int]]]:
    """Return a chart as rows of characters, each with the number of its color, or -1.

    Args:
        chart: The chart.
        width: Characters of a row, without the numbers on the left.
        height: Rows, without the numbers below.
        dots: Whether the terminal has Braille, eight dots in a character; else one letter per
            curve is drawn.
    """
    across, down = (2, 4) if dots else (1, 1)
    drawn: dict[tuple[int, int], tuple[int, int]] = {}  # row, column -> dots, color
    for curve in chart.curves:
        points = chart.points(curve, 0, 0, width * across - 1, height * down - 1)
        for x, y in _walk(points):
            row, column = y // down, x // across
            bits, color = drawn.get((row, column), (0, curve.color))
            bits = bits if color == curve.color else 0
            drawn[row, column] = bits | _DOTS[y % down][x % across], curve.color
    rows = []
    for row in range(height):
        cells = [drawn.get((row, column)) for column in range(width)]
        rows.append([_character(cell, dots=dots) for cell in cells])
    return rows


def _character(cell: tuple[int, int] | None, *, dots: bool) -> tuple[str, int]:
    if cell is None:
        return " ", -1
    bits, color = cell
    return chr(0x2800 + bits) if dots else _LETTERS[color % len(_LETTERS)], color


def _walk(points: Sequence[tuple[float, float]]) -> Iterator[tuple[int, int]]:
    """Yield the places that the lines between points pass."""
    for (x, y), (x_next, y_next) in zip(points, points[1:] or points[:1], strict=False):
        n = max(math.ceil(max(abs(x_next - x), abs(y_next - y))), 1)
        for i in range(n + 1):
            yield round(x + (x_next - x) * i / n), round(y + (y_next - y) * i / n)


@dataclass(frozen=True)
class _Shape:
    """A line through points, or a text at the first of them."""

    points: Sequence[tuple[float, float]]
    color: str
    width: float = 1.0
    text: str = ""
    size: int = 12
    anchor: str = "lm"  # as Pillow has it: left, middle, right; middle, top


def _shapes(chart: Chart, left: float) -> Iterator[_Shape]:
    """Yield all that a chart consists of, from the back to the front."""
    x0, x1, y0, y1 = left + _LEFT, left + WIDTH - _RIGHT, _TOP, HEIGHT - _BOTTOM
    yield _Shape([(x0, _TOP / 2)], INK, text=chart.title, size=15)
    for tick in ticks(chart.low, chart.high, 4):
        y = y1 - (tick - chart.low) / (chart.high - chart.low) * (y1 - y0)
        yield _Shape([(x0, y), (x1, y)], GRID)
        yield _Shape([(x0 - 8, y)], _SOFT, text=number_text(tick), anchor="rm")
    for tick in ticks(0, chart.end, 4):
        x = x0 + tick / chart.end * (x1 - x0)
        yield _Shape([(x, y1 + 6)], _SOFT, text=f"{tick:,.0f}", anchor="mt")
    yield _Shape([((x0 + x1) / 2, y1 + 24)], _SOFT, text="environment steps", anchor="mt")
    yield _Shape([(x0, y0), (x0, y1), (x1, y1)], FRAME)
    for curve in chart.curves:
        color = COLORS[curve.color % len(COLORS)]
        width = 1.0 if curve.is_faint else 2.2
        yield _Shape(chart.points(curve, x0, y0, x1, y1), color, width)
    for line, curve in enumerate(_labeled(chart)):
        y = HEIGHT + line * _LEGEND + 2
        color = COLORS[curve.color % len(COLORS)]
        yield _Shape([(x0, y), (x0 + 18, y)], color, 2.2)
        yield _Shape([(x0 + 26, y)], INK, text=curve.label)


def _labeled(chart: Chart) -> list[Curve]:
    return [curve for curve in chart.curves if curve.label]


def _legend_height(charts: Sequence[Chart]) -> int:
    n_lines = max(len(_labeled(chart)) for chart in charts)
    return n_lines * _LEGEND + 6 if n_lines else 0


def _paint(draw: Any, shape: _Shape) -> None:
    places = [(x * _SMOOTH, y * _SMOOTH) for x, y in shape.points]
    if shape.text:
        letters = font(shape.size * _SMOOTH)
        draw.text(places[0], shape.text, fill=shape.color, font=letters, anchor=shape.anchor)
    elif len(places) > 1:
        draw.line(places, fill=shape.color, width=round(shape.width * _SMOOTH), joint="curve")
    elif places:
        draw.circle(places[0], 2 * _SMOOTH, fill=shape.color)


def _svg_element(shape: _Shape) -> str:
    if shape.text:
        x, y = shape.points[0]
        anchor = {"l": "start", "m": "middle", "r": "end"}[shape.anchor[0]]
        baseline = {"m": "central", "t": "hanging"}[shape.anchor[1]]
        return (
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{shape.size}" fill="{shape.color}" '
            f'text-anchor="{anchor}" dominant-baseline="{baseline}">{escape(shape.text)}</text>'
        )
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shape.points)
    return (
        f'<polyline points="{points}" fill="none" stroke="{shape.color}" '
        f'stroke-width="{shape.width}" stroke-linejoin="round"/>'
    )
