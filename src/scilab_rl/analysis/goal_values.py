"""The value of a start state for each goal, as a map and painted into the scene."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.analysis.goal_space import GoalSpace
from scilab_rl.charts import heat_color

if TYPE_CHECKING:  # heavy
    import gymnasium as gym

    from scilab_rl.learning.inspector import AgentInspector

SIDE = 64
_MOST_SLICES = 3


@dataclass(frozen=True)
class ValueMap:
    """Values of one start state for many goals, at one place of the third axis.

    Attributes:
        values: Along the first and the second axis; of one axis, one column. Shapes: ``(n, m)``.
        at: The place on the third axis; None where there is none.
        seconds: CPU time of the networks.
    """

    values: np.ndarray
    at: float | None
    seconds: float


def value_maps(
    inspector: AgentInspector, start: Mapping[str, np.ndarray], space: GoalSpace
) -> list[ValueMap]:
    """Ask for the value of a start state with each goal of a fine grid.

    Args:
        inspector: The agent; it must have values.
        start: The observation of a start state; its desired goal is replaced.
        space: The goals.
    """
    rng = np.random.default_rng(0)
    maps = []
    for at in _slices(space):
        places = _places(space, at)
        goals = space.goals(places.reshape(-1, places.shape[-1]), rng)
        begin = time.process_time()
        values = inspector.values(_with_goals(start, goals))
        seconds = time.process_time() - begin
        maps.append(ValueMap(values.reshape(places.shape[:2]), at, seconds))
    return maps


def painted(
    env: gym.Env, space: GoalSpace, maps: Sequence[ValueMap], low: float, high: float
) -> list[np.ndarray | None]:
    """Return the present scene with each map painted into it; None where that is not possible.

    Args:
        env: Made with ``render_mode="rgb_array"``, in the start state.
        space: The goals.
        maps: From `value_maps`.
        low: The value that has the first color.
        high: The value that has the last one.
    """
    from scilab_rl.envs.frames import set_simulator_state, simulator_state

    nothing: list[np.ndarray | None] = [None] * len(maps)
    state = simulator_state(env)
    if state is None:  # only MuJoCo has a camera that we know
        return nothing
    from scilab_rl.envs.scene_painting import paint, view_scene

    frames = [frame for one in maps if (frame := _frame(env, space, one.at)) is not None]
    if len(frames) < len(maps):
        return nothing
    with contextlib.suppress(Exception):  # without OpenGL, or with a renderer of its own
        ends = np.array([[corner, corner + sides.sum(axis=0)] for corner, sides in frames])
        low_end, high_end = ends.min(axis=(0, 1)), ends.max(axis=(0, 1))
        size = float(np.linalg.norm(high_end - low_end))
        scene = view_scene(env, (low_end + high_end) / 2, size)
        set_simulator_state(env, state)
        if scene is not None:
            return [
                paint(scene, *frame, _colors(one.values, low, high))
                for frame, one in zip(frames, maps, strict=True)
            ]
    return nothing


def _frame(
    env: gym.Env, space: GoalSpace, at: float | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a corner and the sides, in the world, of the part of the goal space that is shown."""
    from scilab_rl.envs.scene_painting import goal_place

    n_sides = min(len(space.axes), 2)
    rest = [] if at is None else [at]
    corners = [space.low[:n_sides]]
    for side in range(n_sides):
        corners.append(corners[0].copy())
        corners[-1][side] = space.high[side]
    places = np.array([[*corner, *rest] for corner in corners])
    goals = space.goals(places, np.random.default_rng(0))
    if space.others:
        return None
    found = [goal_place(env, goal, space.axes) for goal in goals]
    if any(place is None for place in found):
        return None
    corner, *others = np.array(found)
    sides = np.array(others) - corner
    return None if (np.abs(sides).max(axis=1) < 1e-6).any() else (corner, sides)


def _slices(space: GoalSpace) -> list[float | None]:
    if len(space.axes) < 3:
        return [None]
    edges = np.linspace(space.low[2], space.high[2], _MOST_SLICES + 1)
    return [float(middle) for middle in (edges[:-1] + edges[1:]) / 2]


def _places(space: GoalSpace, at: float | None) -> np.ndarray:
    """Return the middles of a fine grid. Shapes: result ``(n, m, n_axes)``."""
    if len(space.axes) == 1:
        shares = (np.arange(SIDE * SIDE) + 0.5) / SIDE**2
        return (space.low + shares[:, None] * (space.high - space.low))[:, None]
    shares = (np.arange(SIDE) + 0.5) / SIDE
    first, second = (space.low[i] + shares * (space.high[i] - space.low[i]) for i in (0, 1))
    parts = list(np.meshgrid(first, second, indexing="ij"))
    if at is not None:
        parts.append(np.full_like(parts[0], at))
    return np.stack(parts, axis=-1)


def _with_goals(start: Mapping[str, np.ndarray], goals: np.ndarray) -> dict[str, np.ndarray]:
    batch = {key: np.repeat(np.asarray(value)[None], len(goals), 0) for key, value in start.items()}
    shape, kind = batch["desired_goal"].shape, batch["desired_goal"].dtype
    return batch | {"desired_goal": goals.reshape(shape).astype(kind)}


def _colors(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the colors of a heat map. Shapes: ``(n, m)``; result ``(n, m, 3)``, uint8."""
    palette = np.array([_rgb(heat_color(share)) for share in np.linspace(0, 1, 256)], np.uint8)
    shares = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    return palette[np.rint(255 * shares).astype(int)]


def _rgb(color: str) -> list[int]:
    return [int(color[i : i + 2], 16) for i in (1, 3, 5)]


def map_picture(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return a map as a picture, the second axis upwards. Shapes: ``(m, n, 3)``, uint8."""
    return _colors(values, low, high).transpose(1, 0, 2)[::-1]
