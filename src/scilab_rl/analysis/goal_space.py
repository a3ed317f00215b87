"""The space of a task's goals: its free dimensions, as the environment draws them, and a grid."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scilab_rl.errors import ConfigError

MOST_AXES = 3
DEFAULT_CELLS = {1: (45,), 2: (15, 15), 3: (9, 9, 3)}
_FIXED = 1e-6  # of the largest range: a dimension that varies less is fixed


@dataclass(frozen=True)
class GoalSpace:
    """Goals as an environment draws them, and the axes along which they are examined.

    Attributes:
        drawn: Desired goals of resets. Shapes: ``(n_drawn, goal_size)``.
        axes: Dimensions that are examined, at most three.
        others: Free dimensions that are not examined; those of drawn goals are taken.
        follows: Dimension to the free one that it equals up to a constant, such as the places of
            two blocks of one tower.
    """

    drawn: np.ndarray
    axes: tuple[int, ...]
    others: tuple[int, ...]
    follows: dict[int, int]

    @classmethod
    def of(cls, drawn: np.ndarray, axes: Sequence[int] | None = None) -> GoalSpace:
        """Find the free dimensions.

        Args:
            drawn: Desired goals of resets. Shapes: ``(n_drawn, goal_size)``.
            axes: The dimensions to examine; None: all free ones, of more than three the widest two.

        Raises:
            ConfigError: If a chosen axis is not free.
        """
        free, follows = free_dimensions(drawn)
        if not free:
            raise ConfigError(
                "The desired goals do not vary, so there is no goal space to examine."
            )
        ranges = np.ptp(drawn, axis=0)
        if axes is None:
            widest = sorted(sorted(free, key=lambda d: -ranges[d])[:2])
            axes = free if len(free) <= MOST_AXES else widest
        wrong = [axis for axis in axes if axis not in free]
        if wrong or not 0 < len(set(axes)) == len(axes) <= MOST_AXES:
            raise ConfigError(
                f"--axes must be one to three different ones of the free dimensions "
                f"{', '.join(map(str, free))}, but it is {', '.join(map(str, axes))}."
            )
        others = tuple(dimension for dimension in free if dimension not in axes)
        return cls(drawn, tuple(axes), others, follows)

    @cached_property
    def low(self) -> np.ndarray:
        """Lowest drawn value on each axis. Shapes: ``(n_axes,)``."""
        return self.drawn[:, self.axes].min(axis=0)

    @cached_property
    def high(self) -> np.ndarray:
        """Highest drawn value on each axis. Shapes: ``(n_axes,)``."""
        return self.drawn[:, self.axes].max(axis=0)

    def goals(self, places: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return goals at places on the axes; all else is as in a goal that was drawn.

        Args:
            places: Shapes: ``(n, n_axes)``; result: ``(n, goal_size)``.
            rng: Chooses the drawn goals, if other dimensions are free.
        """
        rows = rng.integers(len(self.drawn), size=len(places)) if self.others else [0] * len(places)
        goals = self.drawn[rows].astype(np.float64)
        for column, axis in enumerate(self.axes):
            shift = places[:, column] - goals[:, axis]
            tied = [axis, *(d for d, leader in self.follows.items() if leader == axis)]
            goals[:, tied] += shift[:, None]
        return goals


@dataclass(frozen=True)
class Grid:
    """Cells of equal size over the axes of a goal space.

    Attributes:
        edges: Borders of the cells on each axis. Shapes: ``(n_cells + 1,)`` each.
    """

    edges: tuple[np.ndarray, ...]

    @classmethod
    def over(cls, space: GoalSpace, n_cells: Sequence[int] | None = None) -> Grid:
        """Divide the axes into cells.

        Args:
            space: The goals.
            n_cells: On each axis; None: about 225 altogether.

        Raises:
            ConfigError: If there is not one number for each axis.
        """
        n_cells = n_cells or DEFAULT_CELLS[len(space.axes)]
        if len(n_cells) != len(space.axes):
            raise ConfigError(
                f"--cells needs one number for each of the axes {', '.join(map(str, space.axes))}, "
                f"but it is {','.join(map(str, n_cells))}."
            )
        ends = zip(space.low, space.high, n_cells, strict=True)
        return cls(tuple(np.linspace(low, high, n + 1) for low, high, n in ends))

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells on each axis."""
        return tuple(len(edges) - 1 for edges in self.edges)

    @property
    def n_cells(self) -> int:
        """Cells altogether."""
        return int(np.prod(self.shape))

    @cached_property
    def centers(self) -> np.ndarray:
        """Middles of the cells, the last axis fastest. Shapes: ``(n_cells, n_axes)``."""
        middles = [(edges[:-1] + edges[1:]) / 2 for edges in self.edges]
        return np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, len(middles))

    def count(self, places: np.ndarray) -> np.ndarray:
        """Count places per cell. Shapes: ``(n, n_axes)``; result ``(n_cells,)``."""
        counts, _ = np.histogramdd(places, bins=list(self.edges))
        return counts.reshape(-1).astype(int)

    def regions(self, chosen: np.ndarray) -> list[np.ndarray]:
        """Return connected groups of chosen cells, the largest first.

        Cells are connected where they share a side.

        Args:
            chosen: Shapes: ``(n_cells,)``, of truth values.

        Returns:
            Indices of the cells of each region.
        """
        left = set(np.flatnonzero(chosen).tolist())
        found = []
        while left:
            region, waiting = [], deque([left.pop()])
            while waiting:
                cell = waiting.popleft()
                region.append(cell)
                near = [n for n in self.neighbors(cell) if n in left]
                left.difference_update(near)
                waiting.extend(near)
            found.append(np.array(sorted(region)))
        return sorted(found, key=lambda region: (-len(region), region[0]))

    def extent(self, region: np.ndarray) -> list[tuple[float, float]]:
        """Return from where to where a region reaches on each axis."""
        places = np.unravel_index(region, self.shape)
        return [
            (float(edges[index.min()]), float(edges[index.max() + 1]))
            for edges, index in zip(self.edges, places, strict=True)
        ]

    def neighbors(self, cell: int) -> list[int]:
        """Return the cells that share a side with one."""
        place = np.array(np.unravel_index(cell, self.shape))
        near = []
        for axis, step in itertools.product(range(len(place)), (-1, 1)):
            other = place.copy()
            other[axis] += step
            if 0 <= other[axis] < self.shape[axis]:
                near.append(int(np.ravel_multi_index(tuple(other), self.shape)))
        return near


def free_dimensions(drawn: np.ndarray) -> tuple[list[int], dict[int, int]]:
    """Return the dimensions that vary by themselves, and those that follow one of them.

    Args:
        drawn: Goals. Shapes: ``(n, goal_size)``.

    >>> free_dimensions(np.array([[0.0, 5.0, 1.0], [1.0, 5.0, 2.0], [3.0, 5.0, 4.0]]))
    ([0], {2: 0})
    """
    ranges = np.ptp(drawn, axis=0)
    smallest = _FIXED * max(float(ranges.max(initial=0.0)), 1e-9)
    free: list[int] = []
    follows: dict[int, int] = {}
    for dimension in np.flatnonzero(ranges > smallest).tolist():
        leader = next(
            (f for f in free if np.ptp(drawn[:, dimension] - drawn[:, f]) <= smallest), None
        )
        if leader is None:
            free.append(dimension)
        else:
            follows[dimension] = leader
    return free, follows
