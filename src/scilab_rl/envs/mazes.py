"""Mazes for a point mass, for an ant, and for a point mass among things that it can push.

The agents are those of Gymnasium-Robotics' PointMaze and AntMaze; maps and options are our own. A
map is a list of rows of equal length: ``#`` wall, ``r`` start, ``g`` goal, ``c`` start or goal,
``.`` free. Without any ``r``, ``g`` and ``c``, every free cell is start and goal.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from scilab_rl.envs.goal import (
    Observation,
    require_choice,
    sparse_cost,
    sparse_reward,
)
from scilab_rl.envs.mujoco_goal import MujocoGoalEnv, package_folder
from scilab_rl.envs.types import Info
from scilab_rl.errors import ConfigError

MAPS = {
    "open": ("#######", "#.....#", "#.....#", "#.....#", "#######"),
    "open_dg": ("#######", "#rgggg#", "#ggggg#", "#ggggg#", "#######"),
    "open_dgr": ("#######", "#ccccc#", "#ccccc#", "#ccccc#", "#######"),
    "small_open_dg": ("#####", "#rgg#", "#ggg#", "#ggg#", "#####"),
    "small_open_dgr": ("#####", "#ccc#", "#ccc#", "#ccc#", "#####"),
    "medium_custom_dgr": (
        "#######",
        "#c.c.c#",
        "#.#.#.#",
        "#c.c.c#",
        "#.#.#.#",
        "#c.c.c#",
        "#######",
    ),
}
_MAX_OBJECTS = 8
_OBJECT_RADIUS = 0.15


def nearness(distance: np.ndarray, threshold: float) -> np.ndarray:
    """Return exp(-distance): 1 at the goal, 0 far away. Shapes: as ``distance``."""
    return np.exp(-np.asarray(distance, dtype=np.float32))


class Maze(MujocoGoalEnv):
    """Walk to a place in a maze. The base of all mazes; made through its subclasses.

    Args:
        agent: MuJoCo description of the agent, whose first two coordinates are x and y.
        maze_map: A name in `MAPS`, or rows of one's own.
        cell_size: Edge of a cell, in m.
        continuing: Whether the episode continues at the goal.
        reset_target: Whether another goal is drawn when one is reached; only when continuing.
        n_objects: Things to push, each with a place of its own at the start.
        n_substeps: Simulation steps per environment step.
        kwargs: Those of `GoalEnv`: reward_type (sparse: 1 at the goal | sparseneg: -1 elsewhere |
            dense: exp(-distance)), threshold, ...

    Attributes:
        rows: The map.
    """

    rewards = MappingProxyType(
        {"sparse": sparse_reward, "sparseneg": sparse_cost, "dense": nearness}
    )
    wall_height = 0.4
    noise = 0.25  # of a cell, around its middle

    def __init__(
        self,
        agent: Path,
        *,
        maze_map: str | Sequence[str],
        cell_size: float,
        continuing: bool,
        reset_target: bool,
        n_substeps: int,
        n_objects: int = 0,
        **kwargs: Any,
    ) -> None:
        if reset_target and not continuing:
            raise ConfigError("env_kwargs.reset_target=true needs env_kwargs.continuing=true.")
        rows = map_rows(maze_map)
        self.rows = rows
        self.n_objects = n_objects
        self.reset_target = bool(reset_target)
        self.cell_size = cell_size
        self.starts = cell_centers(rows, "rc", cell_size)
        self.goals = cell_centers(rows, "gc", cell_size)
        self._refuse_unreachable_distance(kwargs.get("threshold"))
        self.camera = {
            "distance": 1.35 * cell_size * max(len(rows), len(rows[0])),
            "azimuth": 90.0,
            "elevation": -65.0,
            "lookat": (0.0, -0.15 * cell_size, 0.0),
        }
        xml = _maze_xml(agent, rows, cell_size, self.wall_height * cell_size, n_objects)
        super().__init__(xml, n_substeps=n_substeps, terminate_on_success=not continuing, **kwargs)

    def _refuse_unreachable_distance(self, threshold: object) -> None:
        """Reject a threshold for which some place has no goal that is not reached already."""
        places = np.concatenate([self.starts, self.goals]) if self.reset_target else self.starts
        distances = np.linalg.norm(places[:, None] - self.goals[None], axis=-1)
        farthest = float(distances.max(axis=1).min() + self.noise * self.cell_size)
        if isinstance(threshold, (int, float)) and threshold >= farthest:
            raise ConfigError(
                f"threshold {threshold:g} is too large for this map: no goal would be farther away "
                f"than that from each start, which allows less than {farthest:g} m."
            )

    def place_objects(self) -> None:
        """Put the agent into a start cell, and the things somewhere else."""
        self.data.qpos[:2] = self._noisy(self.starts)
        taken = [self.data.qpos[:2].copy()]
        floor = np.concatenate([self.starts, self.goals])
        while len(taken) <= self.n_objects:
            place = self._noisy(floor)
            if min(np.linalg.norm(place - other) for other in taken) > 2.2 * _OBJECT_RADIUS:
                taken.append(place)
        # Their slide joints come last, and count from the origin.
        self.data.qpos[self.model.nq - 2 * self.n_objects :] = np.ravel(taken[1:])

    def sample_goal(self) -> np.ndarray:
        """Draw a place in a goal cell that is not reached already."""
        while True:
            goal = self._noisy(self.goals)
            too_near = max(self.threshold, 0.5 * self.cell_size)
            if np.linalg.norm(goal - self.data.qpos[:2]) > too_near:
                return goal

    def achieved_goal(self) -> np.ndarray:
        """Return the agent's place. Shapes: ``(2,)`` in m."""
        return self.data.qpos[:2]

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, Info]:
        """Act for one step; with ``reset_target``, a reached goal is followed by another."""
        result = super().step(action)
        if self.reset_target and result[-1]["is_success"]:
            self.goal = self.sample_goal().astype(np.float32)
        return result

    def goal_markers(self) -> dict[str, np.ndarray]:
        """Draw the goal as a ball."""
        return {"goal": np.array([*self.goal, 0.5 * self.wall_height * self.cell_size])}

    def _noisy(self, places: np.ndarray) -> np.ndarray:
        place = places[self.np_random.integers(len(places))]
        return place + self.cell_size * self.np_random.uniform(-self.noise, self.noise, 2)


class PointMaze(Maze):
    """Push a point mass through a maze.

    The observation is place and velocity, then those of the things that can be pushed.

    Args:
        maze_map: A name in `MAPS`, or rows of one's own.
        continuing: Whether the episode continues at the goal.
        reset_target: Whether another goal is drawn when one is reached.
        n_objects: Things in the way that can be pushed, from 0 to 8.
        threshold: Distance up to which the goal counts as reached, in m.
        kwargs: Those of `Maze` and `GoalEnv`.
    """

    action_size = 2
    max_speed = 5.0  # m/s

    def __init__(
        self,
        maze_map: str | Sequence[str] = "small_open_dgr",
        *,
        continuing: bool = True,
        reset_target: bool = False,
        n_objects: int = 0,
        threshold: float = 0.5,
        **kwargs: Any,
    ) -> None:
        require_choice("n_objects", n_objects, range(_MAX_OBJECTS + 1))
        super().__init__(
            package_folder("gymnasium_robotics") / "envs" / "assets" / "point" / "point.xml",
            maze_map=maze_map,
            cell_size=1.0,
            continuing=continuing,
            reset_target=reset_target,
            n_objects=n_objects,
            n_substeps=1,
            threshold=threshold,
            **kwargs,
        )

    def set_control(self, action: np.ndarray) -> None:
        """Push the mass, whose speed is limited."""
        self.data.qvel[:2] = np.clip(self.data.qvel[:2], -self.max_speed, self.max_speed)
        self.data.ctrl[:] = action

    def get_observation(self) -> np.ndarray:
        """Return places and velocities. Shapes: ``(4 + 4 n_objects,)`` in m and m/s."""
        return np.concatenate([self.data.qpos, self.data.qvel])


class PointObjMaze(PointMaze):
    """The same with four things in the way.

    Args:
        n_objects: How many, from 0 to 8.
        kwargs: Those of `PointMaze`.
    """

    def __init__(
        self, maze_map: str | Sequence[str] = "small_open_dgr", n_objects: int = 4, **kwargs: Any
    ) -> None:
        super().__init__(maze_map, n_objects=n_objects, **kwargs)


class AntMaze(Maze):
    """Walk through a maze with Gymnasium's ant.

    The observation is height, orientation and joint angles, then all velocities.

    Args:
        maze_map: A name in `MAPS`, or rows of one's own.
        continuing: Whether the episode continues at the goal.
        reset_target: Whether another goal is drawn when one is reached.
        frame_skip: Simulation steps of 10 ms per environment step.
        threshold: Distance up to which the goal counts as reached, in m.
        kwargs: Those of `Maze` and `GoalEnv`.
    """

    action_size = 8
    wall_height = 0.25

    def __init__(
        self,
        maze_map: str | Sequence[str] = "small_open_dgr",
        *,
        continuing: bool = True,
        reset_target: bool = False,
        frame_skip: int = 5,
        threshold: float = 1.5,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            package_folder("gymnasium") / "envs" / "mujoco" / "assets" / "ant.xml",
            maze_map=maze_map,
            cell_size=4.0,
            continuing=continuing,
            reset_target=reset_target,
            n_substeps=frame_skip,
            threshold=threshold,
            **kwargs,
        )

    def get_observation(self) -> np.ndarray:
        """Return what the ant feels of itself. Shapes: ``(27,)``."""
        return np.concatenate([self.data.qpos[2:], self.data.qvel])


def map_rows(maze_map: str | Sequence[str]) -> tuple[str, ...]:
    """Return the rows of a map, checked.

    Raises:
        ConfigError: If there is no such map, or it is not a rectangle with free cells.
    """
    if isinstance(maze_map, str):
        require_choice("maze_map", maze_map, MAPS)
        return MAPS[maze_map]
    rows = tuple(map(str, maze_map))
    if not rows or any(len(row) != len(rows[0]) or set(row) - set("#.rgc") for row in rows):
        raise ConfigError(
            "env_kwargs.maze_map must be rows of equal length of the characters # . r g c, but it "
            f"is {list(rows)}."
        )
    for role, cells in (("starts", "rc"), ("goals", "gc")):
        if len(cell_centers(rows, cells, 1.0)) == 0:
            raise ConfigError(f"env_kwargs.maze_map has no {role}: mark some with one of {cells}.")
    if len(cell_centers(rows, "rgc", 1.0)) < 2:
        raise ConfigError("env_kwargs.maze_map needs a goal in another cell than the start.")
    return rows


def cell_centers(rows: Sequence[str], kinds: str, cell_size: float) -> np.ndarray:
    """Return the middles of the cells of some kinds; the middle of the map is the origin.

    Args:
        rows: The map, its first row at the largest y.
        kinds: Characters; in a map without any of ``rgc`` the free cells are meant.
        cell_size: In m.

    Shapes:
        result: ``(n_cells, 2)`` in m.
    """
    if kinds != "#" and not set("rgc") & set("".join(rows)):
        kinds = "."
    middle = (len(rows[0]) - 1) / 2, (len(rows) - 1) / 2
    cells = [
        (column - middle[0], middle[1] - row)
        for row, text in enumerate(rows)
        for column, kind in enumerate(text)
        if kind in kinds
    ]
    return cell_size * np.array(cells).reshape(-1, 2)


def _maze_xml(
    agent: Path, rows: Sequence[str], cell_size: float, height: float, n_objects: int
) -> str:
    """Return the agent's description with walls, things to push and the goal's marker."""
    root = ET.parse(agent).getroot()
    world = root.find("worldbody")
    assert world is not None  # both files have one
    half, solid = cell_size / 2, {"contype": "1", "conaffinity": "1"}
    for x, y in cell_centers(rows, "#", cell_size):
        wall = {"pos": f"{x} {y} {height / 2}", "size": f"{half} {half} {height / 2}"}
        ET.SubElement(world, "geom", wall | solid, type="box", rgba="0.7 0.5 0.3 1")
    for index in range(n_objects):
        body = ET.SubElement(world, "body", name=f"object{index}")
        for axis, direction in (("x", "1 0 0"), ("y", "0 1 0")):
            name = f"object{index}_{axis}"
            ET.SubElement(body, "joint", name=name, type="slide", axis=direction, damping="5")
        size = {"type": "cylinder", "size": f"{_OBJECT_RADIUS} 0.1", "density": "200"}
        ET.SubElement(body, "geom", size | solid, rgba="0.85 0.3 0.25 1")
    radius = f"{0.15 * cell_size}"
    ET.SubElement(world, "site", name="goal", size=radius, rgba="0.9 0.15 0.15 0.7")
    return ET.tostring(root, encoding="unicode")
