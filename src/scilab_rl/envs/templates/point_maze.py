"""A point mass has to find its way through a maze. Say here what your task is."""

from __future__ import annotations

from typing import Any

from scilab_rl.envs.mazes import PointMaze

# Wall #, free ., start r, goal g, start or goal c.
MAP = (
    "#######",
    "#r..#g#",
    "#.#.#.#",
    "#.#...#",
    "#######",
)


class MyTask(PointMaze):
    """Go round the corners, from the upper left to the upper right."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(MAP, **kwargs)
