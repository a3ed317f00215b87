"""Scripted controllers, which show how a task is solved: Fetch, one block, mazes for a point mass.

They read observations as an agent does and need no learning; demonstrations come from them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.errors import ConfigError, listing

_STEP = 0.05  # m, of a Fetch gripper at an action of 1
_ABOVE = 0.09  # m, where the gripper clears an object
_OPEN, _CLOSED = 1.0, -1.0


class Controller(ABC):
    """Chooses an action for each observation of an episode."""

    def begin(self) -> None:  # noqa: B027 - most have no memory
        """Begin an episode."""

    @abstractmethod
    def act(self, observation: Any) -> np.ndarray:
        """Return the action, in the environment's units."""


class Reach(Controller):
    """Moves a gripper straight to its goal."""

    def act(self, observation: Any) -> np.ndarray:
        """Return the action."""
        place = observation["achieved_goal"]
        return _movement(place, observation["desired_goal"], 0.0)


class Push(Controller):
    """Goes behind an object, and pushes it towards the goal."""

    behind = 0.08  # m
    width = 0.02  # m, how far from the line of the push the gripper may be

    def act(self, observation: Any) -> np.ndarray:
        """Return the action."""
        gripper, thing = observation["observation"][:3], observation["observation"][3:6]
        way = observation["desired_goal"][:2] - thing[:2]
        distance = float(np.linalg.norm(way))
        if distance < 0.02:
            return _movement(gripper, gripper, _CLOSED)
        return self.push(gripper, thing, way / distance, min(1.0, 0.2 + 5.0 * distance))

    def push(
        self, gripper: np.ndarray, thing: np.ndarray, direction: np.ndarray, speed: float
    ) -> np.ndarray:
        """Return the action that pushes a thing, or brings the gripper to where it can.

        Args:
            gripper: Its place.
            thing: Place of the thing.
            direction: Of the push, a unit vector in the plane.
            speed: As a share of the largest action.
        """
        sideways = np.array([-direction[1], direction[0]])
        offset = gripper[:2] - thing[:2]
        along, aside = float(offset @ direction), float(offset @ sideways)
        is_low = gripper[2] < thing[2] + 0.03
        if is_low and along < -0.02 and abs(aside) < self.width:
            step = _movement(gripper, np.array([*gripper[:2], thing[2]]), _CLOSED)
            step[:2] = speed * direction - 15.0 * aside * sideways
            step[:2] /= max(1.0, float(np.abs(step[:2]).max()))
            return step
        start = thing[:2] - self.behind * direction
        if np.linalg.norm(gripper[:2] - start) < 0.02:  # down
            return _movement(gripper, np.array([*start, thing[2]]), _CLOSED)
        if gripper[2] < thing[2] + 0.06 and np.linalg.norm(offset) < 0.12:  # up
            return _movement(gripper, np.array([*gripper[:2], thing[2] + _ABOVE]), _CLOSED)
        height = max(float(gripper[2]), thing[2] + _ABOVE)
        return _movement(gripper, np.array([*start, height]), _CLOSED)


class Slide(Push):
    """Goes behind a puck, and strikes it so that it slides to the goal.

    Drag and stroke are fitted to the simulation. The flat fingers push the puck more along x than
    they move themselves, so that y is exaggerated. About a third of the strikes arrive.
    """

    width = 0.03
    drag = 0.0012  # m per step and step, by which a sliding puck slows down
    stroke = 0.038  # m per step, of a puck that is struck by an action of 1
    exaggeration = np.array([1.0, 1.15])

    def __init__(self) -> None:
        self._is_struck = False

    def begin(self) -> None:
        """Begin an episode."""
        self._is_struck = False

    def act(self, observation: Any) -> np.ndarray:
        """Return the action."""
        numbers = observation["observation"]
        gripper, thing = numbers[:3], numbers[3:6]
        way = observation["desired_goal"][:2] - thing[:2]
        distance = float(np.linalg.norm(way))
        direction = way * self.exaggeration
        direction /= max(float(np.linalg.norm(direction)), 1e-6)
        speed = float((numbers[14:16] + numbers[20:22]) @ direction)  # the puck's, m per step
        wanted = np.sqrt(2.0 * self.drag * distance)
        self._is_struck |= bool(speed >= wanted)
        if self._is_struck:
            return _movement(gripper, gripper, _CLOSED)
        return self.push(gripper, thing, direction, wanted / self.stroke)


class PickAndPlace(Controller):
    """Grasps an object from above and carries it to the goal.

    A goal of six numbers is the gripper's place and the object's: the object is put down, and the
    gripper leaves it.
    """

    def __init__(self) -> None:
        self._n_closed = 0
        self._is_left = False

    def begin(self) -> None:
        """Begin an episode."""
        self._n_closed = 0
        self._is_left = False

    def act(self, observation: Any) -> np.ndarray:
        """Return the action."""
        numbers, goal = observation["observation"], observation["desired_goal"]
        gripper, thing = numbers[:3], numbers[3:6]
        offset = thing - gripper
        self._is_left |= len(goal) == 6 and bool(np.linalg.norm(thing - goal[3:]) < 0.01)
        if self._is_left:
            return self._leave(gripper, thing, goal[:3])
        if self._n_closed and np.linalg.norm(offset) > 0.05:
            self._n_closed = 0  # it was lost
        aside = float(np.linalg.norm(offset[:2]))
        if self._n_closed or (aside < 0.01 and abs(offset[2]) < 0.01):
            self._n_closed += 1
            is_held = self._n_closed > 3  # closing takes some steps
            return _movement(
                thing if is_held else gripper, goal[-3:] if is_held else thing, _CLOSED
            )
        if aside < 0.01 or (aside < 0.02 and abs(offset[2]) < 0.04):
            return _movement(gripper, thing, _OPEN)
        return _movement(gripper, thing + np.array([0.0, 0.0, _ABOVE]), _OPEN)

    def _leave(self, gripper: np.ndarray, thing: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Open the fingers, and go up before going anywhere else."""
        aside = np.linalg.norm(gripper[:2] - thing[:2])
        if aside < 0.08 and gripper[2] < thing[2] + 0.045:
            return _movement(
                gripper, np.array([*thing[:2], max(thing[2] + 0.05, target[2])]), _OPEN
            )
        return _movement(gripper, target, _OPEN)


class PointMaze(Controller):
    """Leads a point mass through a maze along a shortest path of cells.

    Args:
        maze: The environment, whose map is read.
    """

    def __init__(self, maze: Any) -> None:
        rows, size = maze.rows, maze.cell_size
        self._size = size
        self._middle = (len(rows[0]) - 1) / 2, (len(rows) - 1) / 2
        self._free = {
            (x, y) for y, row in enumerate(rows) for x, kind in enumerate(row) if kind != "#"
        }

    def act(self, observation: Any) -> np.ndarray:
        """Return the action."""
        place, goal = observation["achieved_goal"], observation["desired_goal"]
        velocity = observation["observation"][len(observation["observation"]) // 2 :][:2]
        path = self._path(self._cell(place), self._cell(goal))
        target = goal if len(path) < 2 else self._center(path[1])
        return np.clip(4.0 * (target - place) - 2.0 * velocity, -1.0, 1.0)

    def _cell(self, place: np.ndarray) -> tuple[int, int]:
        x, y = place / self._size
        return round(float(x) + self._middle[0]), round(self._middle[1] - float(y))

    def _center(self, cell: tuple[int, int]) -> np.ndarray:
        return self._size * np.array([cell[0] - self._middle[0], self._middle[1] - cell[1]])

    def _path(self, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
        """Return the cells of a shortest path; only the start where there is none."""
        reached_from, waiting = {goal: goal}, deque([goal])
        while waiting and start not in reached_from:
            x, y = cell = waiting.popleft()
            for near in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
                if near in self._free and near not in reached_from:
                    reached_from[near] = cell
                    waiting.append(near)
        path = [start]
        while path[-1] in reached_from and path[-1] != goal:
            path.append(reached_from[path[-1]])
        return path


_FETCH: Mapping[str, Callable[[], Controller]] = {
    "FetchReach": Reach, "FetchPush": Push, "FetchSlide": Slide, "FetchPickAndPlace": PickAndPlace,
}  # fmt: skip


def controller_for(env: gym.Env) -> Controller:
    """Return the controller of an environment.

    Raises:
        ConfigError: If there is none.
    """
    task: Any = env.unwrapped
    family = (env.spec.id if env.spec is not None else "").partition("-")[0]
    if family in _FETCH:
        return _FETCH[family]()
    if type(task).__name__ == "Blocks" and task.n_blocks == 1:
        return PickAndPlace()
    if type(task).__name__ == "PointMaze" and task.n_objects == 0:
        return PointMaze(task)
    raise ConfigError(
        f"There is no scripted controller for {env.spec.id if env.spec else task}; there are those "
        f"of {listing(_FETCH)}, Blocks with one block and PointGym."
    )


def _movement(place: np.ndarray, target: np.ndarray, fingers: float) -> np.ndarray:
    """Return the action that moves a gripper from a place towards another."""
    return np.array([*((target - place) / _STEP), fingers]).clip(-1.0, 1.0)
