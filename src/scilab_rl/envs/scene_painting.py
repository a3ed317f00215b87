"""Painting a map of the goal space into the rendered scene of a MuJoCo task, by its camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.mujoco_goal import MujocoGoalEnv

_BEHIND = 0.002  # m: what is less behind something is still drawn
_HALF_WIDTH = 0.02  # m: of the strip that stands for a goal space of one dimension
_OPACITY = 0.62
_STEEP = -42.0  # degrees: the camera looks down at least so much, to see a plane
_DISTANCE = 2.2  # of the camera, times the size of what it looks at


@dataclass(frozen=True)
class Scene:
    """A rendered picture with what it takes to draw into it at places of the world.

    Attributes:
        picture: Shapes: ``(height, width, 3)``, uint8.
        depth: Distance along the camera's direction, in m. Shapes: ``(height, width)``.
        camera: The camera's place, in m. Shapes: ``(3,)``.
        rays: For each pixel, from the camera to the plane at a depth of 1 m. Shapes: ``(height,
            width, 3)``.
    """

    picture: np.ndarray
    depth: np.ndarray
    camera: np.ndarray
    rays: np.ndarray

    def pixel(self, place: np.ndarray) -> tuple[float, float]:
        """Return column and row at which a place of the world is seen. Shapes: ``(3,)`` in m."""
        height, width = self.depth.shape
        middle = self.rays[height // 2, width // 2]
        across = (self.rays[0, -1] - self.rays[0, 0]) / (width - 1)
        down = (self.rays[-1, 0] - self.rays[0, 0]) / (height - 1)
        matrix = np.stack([across, down, middle], axis=1)
        x, y, depth = np.linalg.solve(matrix, np.asarray(place) - self.camera)
        return width // 2 + x / depth, height // 2 + y / depth


def view_scene(env: gym.Env, target: np.ndarray, size: float) -> Scene | None:
    """Render an environment; None where it is not one of MuJoCo with Gymnasium's renderer.

    Args:
        env: Made with ``render_mode="rgb_array"``, and reset.
        target: What is looked at, in m; from the environment's own side. Shapes: ``(3,)``.
        size: Of that, in m.
    """
    inner: Any = env.unwrapped
    if not isinstance(getattr(inner, "data", None), mujoco.MjData):
        return None
    picture = env.render()
    renderer = getattr(inner, "mujoco_renderer", None) or getattr(inner, "_renderer", None)
    if renderer is None or not isinstance(picture, np.ndarray):
        return None
    viewer, camera = renderer.viewer, renderer.viewer.cam
    original = camera.lookat.copy(), camera.distance, camera.elevation
    if renderer.camera_id == -1:  # not one that the model holds
        camera.lookat[:], camera.distance = target, _DISTANCE * size
        camera.elevation = min(camera.elevation, _STEEP)
    try:
        picture, buffer = viewer.render("rgbd_tuple", camera_id=renderer.camera_id)
    finally:
        camera.lookat[:], camera.distance, camera.elevation = original
    left, right = viewer.scn.camera
    near, far = float(left.frustum_near), float(left.frustum_far)
    # OpenGL's depth buffer is 0 at the near plane and 1 at the far one.
    depth = near * far / (far - np.asarray(buffer, np.float64) * (far - near))
    return Scene(
        np.array(picture), depth, (left.pos + right.pos) / 2, _rays(left, picture.shape[:2])
    )


def _rays(camera: Any, size: tuple[int, ...]) -> np.ndarray:
    height, width = size
    top, bottom = (
        camera.frustum_top / camera.frustum_near,
        camera.frustum_bottom / camera.frustum_near,
    )
    forward, up = np.array(camera.forward, np.float64), np.array(camera.up, np.float64)
    half_width = (top - bottom) / 2 * width / height
    x = half_width * (2 * (np.arange(width) + 0.5) / width - 1)
    y = top + (bottom - top) * (np.arange(height) + 0.5) / height
    right = np.cross(forward, up)
    return forward + x[None, :, None] * right + y[:, None, None] * up


def goal_place(env: gym.Env, goal: np.ndarray, axes: tuple[int, ...]) -> np.ndarray | None:
    """Return where in the world a goal is; None where that is not known.

    Our own tasks say where they draw a goal; a goal of three numbers in another MuJoCo task is a
    place.

    Args:
        env: A task in MuJoCo.
        goal: Shapes: ``(goal_size,)``.
        axes: The dimensions of interest: of several places the one that depends on them.

    Shapes:
        result: ``(3,)`` in m.
    """
    inner = env.unwrapped
    if isinstance(inner, MujocoGoalEnv):
        present, places = inner.goal, []
        try:
            for shift in (0.0, 1.0):
                inner.goal = np.array(goal, np.float64)
                inner.goal[list(axes)] += shift
                places.append(inner.goal_markers())
        finally:
            inner.goal = present
        moved = [n for n in places[0] if not np.allclose(places[0][n], places[1][n])]
        return np.asarray(places[0][moved[0]], np.float64) if moved else None
    if isinstance(inner, GoalEnv) or np.shape(goal) != (3,):
        return None
    return np.asarray(goal, np.float64)


def paint(scene: Scene, corner: np.ndarray, sides: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Return the scene with a colored parallelogram in it, behind what is before it.

    Args:
        scene: The scene.
        corner: One corner, in m. Shapes: ``(3,)``.
        sides: From there to its neighbors, in m. Shapes: ``(2, 3)``; of one side only, ``(1, 3)``,
            a strip is painted.
        colors: Of its cells along both sides. Shapes: ``(n, m, 3)``, uint8.

    Shapes:
        result: ``(height, width, 3)``, uint8.
    """
    if len(sides) == 1:
        across = np.cross([0.0, 0.0, 1.0], sides[0])
        across = 2 * _HALF_WIDTH * across / np.linalg.norm(across)
        corner, sides = corner - across / 2, np.stack([sides[0], across])
    # corner + a side0 + b side1 = camera + depth ray
    first, second = sides
    normal = np.cross(first, second)
    along = scene.rays @ normal
    depth = ((corner - scene.camera) @ normal) / np.where(np.abs(along) < 1e-12, np.nan, along)
    offset = scene.camera + depth[..., None] * scene.rays - corner
    shares = offset @ np.linalg.pinv(sides)
    inside = (shares >= 0).all(axis=-1) & (shares < 1).all(axis=-1)
    visible = inside & (depth > 0) & (depth <= scene.depth + _BEHIND)
    rows, columns = ((shares[visible][:, axis] * colors.shape[axis]).astype(int) for axis in (0, 1))
    painted = scene.picture.astype(np.float64)
    painted[visible] += _OPACITY * (colors[rows, columns] - painted[visible])
    return np.rint(painted).astype(np.uint8)
