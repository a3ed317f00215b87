"""Pictures of goal tasks that have none of their own: what is achieved, what is desired, and when.

One dimension is a line with the past above it, two are a plane, three a box seen from above with
shadows on its floor, and more are one line each.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from scilab_rl.drawing import (
    ACHIEVED,
    BACKGROUND,
    DESIRED,
    FAINT,
    FRAME,
    GRID,
    INK,
    REACHED,
    font,
    number_text,
    ticks,
)

if TYPE_CHECKING:
    from PIL.Image import Image

Coordinate = TypeVar("Coordinate", float, np.ndarray)
SIDE = 480  # pixels of a frame
_SMOOTH = 2  # drawn twice as large and scaled down
_LEFT, _TOP, _AREA = 44, 50, 404  # pixels: where the square that holds the scene lies
_MOST_POINTS = 500  # of the trail; older ones are dropped
_HEADER = 22  # pixels: the middle of the words above
_DOT = 6  # pixels: radius of the achieved goal
_PAST = 5  # pixels per step of the past, in one dimension
_MOST_LINES = 12  # dimensions that are drawn when there are more than three
_AZIMUTH, _ELEVATION = math.radians(-60), math.radians(24)


class GoalDrawing:
    """Draws one environment; axes grow when something lies outside, and never shrink.

    Args:
        limits: Range of all axes; None: what has been seen decides.
    """

    def __init__(self, limits: tuple[float, float] | None = None) -> None:
        self._seen = (math.inf, -math.inf) if limits is None else limits
        self._counts_radius = limits is None
        self.trail: deque[np.ndarray] = deque(maxlen=_MOST_POINTS)
        self._grid: tuple[object, Image] | None = None  # what it was drawn for, and the image

    def begin_episode(self, achieved: np.ndarray) -> None:
        """Begin a trail."""
        self.trail.clear()
        self.add(achieved)

    def add(self, achieved: np.ndarray) -> None:
        """Lengthen the trail; values that are not numbers are skipped. Shapes: ``(goal_size,)``."""
        place = np.array(achieved, np.float64).reshape(-1)
        if np.isfinite(place).all():
            self.trail.append(place)

    def frame(
        self,
        desired: np.ndarray,
        threshold: float,
        distance: float,
        *,
        reached: bool,
        is_euclidean: bool,
    ) -> np.ndarray:
        """Return the scene.

        Args:
            desired: The goal. Shapes: ``(goal_size,)``.
            threshold: Distance up to which it counts as reached.
            distance: How far it is away.
            reached: Whether it is reached.
            is_euclidean: Whether the threshold is a distance that can be drawn to scale.

        Shapes:
            result: ``(480, 480, 3)``, uint8.
        """
        goal = np.nan_to_num(np.array(desired, np.float64).reshape(-1))
        radius = float(threshold) if is_euclidean else 0.0
        view = self._view(goal, radius)
        color = REACHED if reached else DESIRED
        canvas = _Canvas(self._background(view, len(goal), color, threshold).copy(), view, color)
        draw = {1: _draw_line, 2: _draw_plane, 3: _draw_box}.get(len(goal), _draw_lines)
        draw(canvas, goal, radius, np.array(self.trail).reshape(-1, len(goal)))
        text = "reached" if reached else f"distance {number_text(distance)}"
        ink = REACHED if reached else INK
        canvas.text(SIDE - 16, _HEADER, text, size=13, color=ink, anchor="rm")
        return np.asarray(canvas.image.reduce(_SMOOTH))

    def _view(self, goal: np.ndarray, radius: float) -> tuple[float, float]:
        """Return the range of the axes, of all that has been seen, to round numbers."""
        room = radius * self._counts_radius
        places = np.concatenate([goal - room, goal + room, *self.trail])
        low, high = min(self._seen[0], places.min()), max(self._seen[1], places.max())
        self._seen = float(low), float(high)
        if high - low < 1e-9 * max(1.0, abs(low), abs(high)):
            low, high = low - 1.0, high + 1.0
        step = np.diff(ticks(low, high, 5)[:2]).item() / 2
        return float(math.floor(low / step + 1e-6) * step), float(
            math.ceil(high / step - 1e-6) * step
        )

    def _background(self, view: tuple[float, float], n: int, color: str, threshold: float) -> Image:
        """Return axes and legend, redrawn only when they change."""
        from PIL import Image as images

        wanted = view, n, color, threshold
        if self._grid is None or self._grid[0] != wanted:
            image = images.new("RGB", (SIDE * _SMOOTH, SIDE * _SMOOTH), BACKGROUND)
            canvas = _Canvas(image, view, color)
            {1: _line_axes, 2: _plane_axes, 3: _box_axes}.get(n, _lines_axes)(canvas, n)
            canvas.write_legend(threshold)
            self._grid = wanted, image
        return self._grid[1]


class _Canvas:
    """A large image on which pixels of the finished frame are drawn."""

    def __init__(self, image: Image, view: tuple[float, float], goal_color: str) -> None:
        from PIL import ImageDraw

        self.image, self.view, self.goal_color = image, view, goal_color
        self.pen = ImageDraw.Draw(image)
        self.scale = _AREA / (view[1] - view[0])  # pixels per unit of the goal

    def x(self, value: Coordinate) -> Coordinate:
        """Return the pixel of a number on the horizontal axis."""
        return _LEFT + (value - self.view[0]) * self.scale

    def y(self, value: Coordinate) -> Coordinate:
        """Return the pixel of a number on the vertical axis, which points up."""
        return _TOP + (self.view[1] - value) * self.scale

    def line(
        self, points: Iterable[tuple[float, float]] | np.ndarray, color: str, width: float = 1.0
    ) -> None:
        """Draw a line through points. Shapes: ``(n, 2)``."""
        flat = [(float(x) * _SMOOTH, float(y) * _SMOOTH) for x, y in points]
        self.pen.line(flat, fill=color, width=max(1, round(width * _SMOOTH)), joint="curve")

    def path(self, points: np.ndarray, color: str, width: float = 2.2) -> None:
        """Draw a line through points that fades towards its beginning. Shapes: ``(n, 2)``."""
        n_shades = 8
        ends = np.linspace(0, len(points) - 1, n_shades + 1).round().astype(int)
        for shade, (first, last) in enumerate(itertools.pairwise(ends)):
            if first < last:
                self.line(
                    points[first : last + 1], tint(color, 0.2 + 0.6 * shade / n_shades), width
                )

    def disc(
        self,
        x: float,
        y: float,
        radius: float,
        fill: str | None = None,
        outline: str | None = None,
        width: int = 1,
    ) -> None:
        """Draw a disc."""
        self.ellipse(x, y, radius, radius, fill, outline, width)

    def ellipse(
        self,
        x: float,
        y: float,
        wide: float,
        high: float,
        fill: str | None = None,
        outline: str | None = None,
        width: int = 1,
    ) -> None:
        """Draw an ellipse with half axes in pixels."""
        box = (x - wide, y - high, x + wide, y + high)
        self.pen.ellipse([side * _SMOOTH for side in box], fill, outline, width)

    def box(
        self,
        left: float,
        top: float,
        right: float,
        bottom: float,
        fill: str | None = None,
        outline: str | None = None,
        width: int = 1,
    ) -> None:
        """Draw a rectangle."""
        self.pen.rectangle(
            [side * _SMOOTH for side in (left, top, right, bottom)], fill, outline, width
        )

    def goal(self, x: float, y: float, radius: float) -> None:
        """Draw a goal to scale, with a cross in its middle that is seen however small it is."""
        if radius:
            self.disc(
                x,
                y,
                radius,
                fill=tint(self.goal_color, 0.16),
                outline=tint(self.goal_color, 0.75),
                width=round(1.5 * _SMOOTH),
            )
        for dx, dy in ((5, 0), (0, 5)):
            self.line([(x - dx, y - dy), (x + dx, y + dy)], self.goal_color, 2)

    def dot(self, x: float, y: float) -> None:
        """Draw the achieved goal, with a ring around it where it is the desired one."""
        if self.goal_color == REACHED:
            self.disc(x, y, _DOT + 4.5, fill=REACHED)
        self.disc(x, y, _DOT + 1.5, fill=BACKGROUND)
        self.disc(x, y, _DOT, fill=ACHIEVED)

    def text(
        self, x: float, y: float, text: str, *, size: int = 11, color: str = FAINT, anchor: str
    ) -> float:
        """Write, and return how wide it is."""
        letters = font(size * _SMOOTH)
        self.pen.text((x * _SMOOTH, y * _SMOOTH), text, fill=color, font=letters, anchor=anchor)
        return float(self.pen.textlength(text, font=letters)) / _SMOOTH

    def write_legend(self, threshold: float) -> None:
        """Say what the colors mean."""
        x, y = 18.0, float(_HEADER)
        self.disc(x, y, 5, fill=ACHIEVED)
        x += 11 + self.text(x + 11, y, "achieved", size=13, color=INK, anchor="lm") + 18
        fill, width = tint(self.goal_color, 0.16), round(1.5 * _SMOOTH)
        self.disc(x, y, 6, fill=fill, outline=self.goal_color, width=width)
        x += 12 + self.text(x + 12, y, "desired", size=13, color=INK, anchor="lm") + 6
        self.text(x, y, f"within {number_text(threshold)}", size=13, anchor="lm")


def tint(color: str, share: float) -> str:
    """Return a color thinned with white.

    >>> tint("#0000ff", 0.2)
    '#ccccff'
    """
    parts = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(255 + (part - 255) * share):02x}" for part in parts)


def _axis_ticks(view: tuple[float, float]) -> list[float]:
    return ticks(*view, 5)


def _plane_axes(canvas: _Canvas, n: int) -> None:
    right, bottom = _LEFT + _AREA, _TOP + _AREA
    for tick in _axis_ticks(canvas.view):
        x, y = canvas.x(tick), canvas.y(tick)
        canvas.line([(x, _TOP), (x, bottom)], GRID)
        canvas.line([(_LEFT, y), (right, y)], GRID)
        canvas.text(x, bottom + 6, number_text(tick), anchor="mt")
        canvas.text(_LEFT - 7, y, number_text(tick), anchor="rm")
    canvas.box(_LEFT, _TOP, right, bottom, outline=FRAME, width=_SMOOTH)


def _draw_plane(canvas: _Canvas, goal: np.ndarray, radius: float, trail: np.ndarray) -> None:
    canvas.goal(canvas.x(goal[0]), canvas.y(goal[1]), radius * canvas.scale)
    points = np.stack([canvas.x(trail[:, 0]), canvas.y(trail[:, 1])], axis=1)
    canvas.path(points, ACHIEVED)
    for x, y in points[-1:]:
        canvas.dot(x, y)


_BASE = _TOP + _AREA - 40  # pixels: the height of the line of one dimension


def _line_axes(canvas: _Canvas, n: int) -> None:
    for tick in _axis_ticks(canvas.view):
        x = canvas.x(tick)
        canvas.line([(x, _TOP), (x, _BASE)], GRID)
        canvas.line([(x, _BASE), (x, _BASE + 5)], FRAME)
        canvas.text(x, _BASE + 14, number_text(tick), anchor="mt")
    canvas.line([(_LEFT, _BASE), (_LEFT + _AREA, _BASE)], FRAME, 2)
    for age in range(0, (_BASE - _TOP) // _PAST + 1, 20):
        text = "now" if not age else f"-{age}"
        canvas.text(_LEFT - 7, _BASE - age * _PAST, text, anchor="rm")


def _draw_line(canvas: _Canvas, goal: np.ndarray, radius: float, trail: np.ndarray) -> None:
    x, half = canvas.x(goal[0]), radius * canvas.scale
    color = canvas.goal_color
    if half:
        canvas.box(x - half, _TOP, x + half, _BASE, fill=tint(color, 0.09))
        for edge in (x - half, x + half):
            canvas.line([(edge, _TOP), (edge, _BASE)], tint(color, 0.35))
        canvas.line([(x - half, _BASE), (x + half, _BASE)], color, 4)
    canvas.line([(x, _BASE - 8), (x, _BASE + 8)], color, 2)
    recent = trail[-((_BASE - _TOP) // _PAST + 1) :, 0]
    ages = np.arange(len(recent))[::-1]
    canvas.path(np.stack([canvas.x(recent), _BASE - _PAST * ages], axis=1), ACHIEVED)
    for place in recent[-1:]:
        canvas.dot(canvas.x(place), _BASE)


class _Projection:
    """Sees a box from its side and above, without perspective, so that lengths stay to scale."""

    def __init__(self, canvas: _Canvas) -> None:
        self.view = canvas.view
        self.middle = sum(canvas.view) / 2
        corners = self._turned(
            np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        )
        half = np.abs(corners).max(axis=0)
        self.scale = (_AREA - 24) / 2 / (half.max() * (canvas.view[1] - canvas.view[0]) / 2)

    def __call__(self, places: ArrayLike) -> np.ndarray:
        """Return pixels. Shapes: places ``(n, 3)``, result ``(n, 2)``."""
        turned = self._turned(np.asarray(places, np.float64) - self.middle) * self.scale
        return turned * (1, -1) + (SIDE / 2, _TOP + _AREA / 2)

    @staticmethod
    def _turned(places: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(places, -1, 0)
        across = x * -math.sin(_AZIMUTH) + y * math.cos(_AZIMUTH)
        away = -(x * math.cos(_AZIMUTH) + y * math.sin(_AZIMUTH))
        up = z * math.cos(_ELEVATION) + away * math.sin(_ELEVATION)
        return np.stack([across, up], axis=-1)

    def floor(self, places: np.ndarray) -> np.ndarray:
        """Return the pixels of shadows."""
        shadows = np.array(places, np.float64)
        shadows[..., 2] = self.view[0]
        return self(shadows)


def _box_axes(canvas: _Canvas, n: int) -> None:
    seen, (low, high) = _Projection(canvas), canvas.view
    # Floor, and the two walls behind: x = low, and y = high.
    for tick in _axis_ticks(canvas.view):
        for a, b in (
            ((tick, low, low), (tick, high, low)),
            ((low, tick, low), (high, tick, low)),
            ((tick, high, low), (tick, high, high)),
            ((low, high, tick), (high, high, tick)),
            ((low, tick, low), (low, tick, high)),
            ((low, low, tick), (low, high, tick)),
        ):
            canvas.line(seen([a, b]), GRID)
        for place, (dx, dy), anchor in (
            ((tick, low, low), (-4, 6), "rt"),
            ((high, tick, low), (6, 5), "lt"),
            ((low, low, tick), (-7, 0), "rm"),
        ):
            [(x, y)] = seen([place])
            if np.allclose(place, (high, low, low), rtol=0, atol=0.13 * (high - low)):
                continue  # two numbers would meet in this corner
            canvas.text(x + dx, y + dy, number_text(tick), anchor=anchor)
    for loop in (
        [(low, low, low), (high, low, low), (high, high, low), (low, high, low), (low, low, low)],
        [(low, low, low), (low, low, high), (low, high, high), (low, high, low)],
        [(low, high, high), (high, high, high), (high, high, low)],
    ):
        canvas.line(seen(loop), FRAME)


def _draw_box(canvas: _Canvas, goal: np.ndarray, radius: float, trail: np.ndarray) -> None:
    seen = _Projection(canvas)
    shadow, half = "#d4d4d8", radius * seen.scale
    [(x, y)], [(floor_x, floor_y)] = seen([goal]), seen.floor(goal[None])
    flat = half * math.sin(_ELEVATION)
    canvas.ellipse(floor_x, floor_y, max(half, 4), max(flat, 2), fill=tint(canvas.goal_color, 0.22))
    points, shadows = seen(trail), seen.floor(trail)
    if len(trail) > 1:
        canvas.line(shadows, "#e4e4e7", 2)
    canvas.line([(floor_x, floor_y), (x, y)], tint(canvas.goal_color, 0.4))
    for (below_x, below_y), (dot_x, dot_y) in zip(shadows[-1:], points[-1:], strict=True):
        canvas.ellipse(below_x, below_y, _DOT, _DOT * math.sin(_ELEVATION), fill=shadow)
        canvas.line([(below_x, below_y), (dot_x, dot_y)], tint(ACHIEVED, 0.4))
    canvas.goal(x, y, half)
    canvas.path(points, ACHIEVED)
    for dot_x, dot_y in points[-1:]:
        canvas.dot(dot_x, dot_y)


def _rows(n: int) -> np.ndarray:
    """Return the heights of lines, one per dimension."""
    n = min(n, _MOST_LINES)
    return _TOP + (np.arange(n) + 0.5) * (_AREA - 20) / n


def _lines_axes(canvas: _Canvas, n: int) -> None:
    heights = _rows(n)
    for tick in _axis_ticks(canvas.view):
        canvas.line([(canvas.x(tick), _TOP), (canvas.x(tick), _TOP + _AREA - 14)], GRID)
        canvas.text(canvas.x(tick), _TOP + _AREA - 6, number_text(tick), anchor="mt")
    for index, y in enumerate(heights):
        canvas.line([(_LEFT, y), (_LEFT + _AREA, y)], FRAME)
        canvas.text(_LEFT - 9, y, str(index), anchor="rm")
    if n > len(heights):
        canvas.text(SIDE - 16, SIDE - 8, f"{n - len(heights)} more dimensions", anchor="rb")


def _draw_lines(canvas: _Canvas, goal: np.ndarray, radius: float, trail: np.ndarray) -> None:
    for index, y in enumerate(_rows(len(goal))):
        x, half = canvas.x(goal[index]), radius * canvas.scale
        if half:
            color = tint(canvas.goal_color, 0.25)
            canvas.box(x - half, y - 5, x + half, y + 5, fill=color)
        canvas.line([(x, y - 8), (x, y + 8)], canvas.goal_color, 2)
        if len(trail):
            past = canvas.x(trail[:, index])
            canvas.line([(past.min(), y), (past.max(), y)], tint(ACHIEVED, 0.45), 2.2)
            canvas.dot(past[-1], y)
