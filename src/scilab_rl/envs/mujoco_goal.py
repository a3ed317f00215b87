"""The base class of goal-conditioned tasks in MuJoCo."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from scilab_rl.envs.goal import GoalEnv, Observation
from scilab_rl.envs.types import Info

ASSETS = Path(__file__).parent / "assets"
_EVERYTHING = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class MujocoGoalEnv(GoalEnv):
    """A `GoalEnv` whose world is a MuJoCo model.

    A subclass gives the model to the constructor, and `sample_goal`, `achieved_goal`,
    `get_observation` as in `GoalEnv`. It may change `set_control` (what an action does),
    `place_objects` (chance at the start of an episode) and `goal_markers` (where the goal is
    drawn).

    Args:
        xml: The model as text.
        n_substeps: Simulation steps per environment step.
        render_mode: None, ``rgb_array`` or ``human``.
        width: Of a frame, in pixels.
        height: Of a frame, in pixels.
        kwargs: Those of `GoalEnv`.

    Attributes:
        camera: Where one looks from: keys of MuJoCo's ``mjvCamera``.
        model: The MuJoCo model.
        data: The MuJoCo state.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 25}  # noqa: RUF012 - Gymnasium's
    camera: Mapping[str, object] = MappingProxyType({})

    def __init__(
        self,
        xml: str,
        *,
        n_substeps: int,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **kwargs: Any,
    ) -> None:
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.n_substeps = n_substeps
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
        # A new dictionary: the class's is shared with every other environment.
        self.metadata = {**type(self).metadata, "render_fps": max(1, round(1.0 / self.dt))}
        self._frame_size = width, height
        self._renderer: Any = None
        self.set_up()
        self._start_state = np.empty(mujoco.mj_stateSize(self.model, _EVERYTHING))
        mujoco.mj_getState(self.model, self.data, self._start_state, _EVERYTHING)
        super().__init__(render_mode=render_mode, **kwargs)

    @property
    def dt(self) -> float:
        """Seconds per environment step."""
        return float(self.model.opt.timestep * self.n_substeps)

    def set_up(self) -> None:
        """Bring the simulation into the state from which each episode starts; done once."""
        mujoco.mj_forward(self.model, self.data)

    def place_objects(self) -> None:
        """Change the start state by chance; `data` is in the start state."""

    def set_control(self, action: np.ndarray) -> None:
        """Turn an action into controls. Shapes: ``(action_size,)``, in [-1, 1]."""
        self.data.ctrl[:] = action

    def goal_markers(self) -> Mapping[str, np.ndarray]:
        """Return where to draw the goal: names of sites of the world body to places (3,) in m."""
        return {}

    def reset_state(self) -> None:
        """Go back to the start state exactly, and place the objects."""
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, self._start_state, _EVERYTHING)
        self.place_objects()
        mujoco.mj_forward(self.model, self.data)

    def apply_action(self, action: np.ndarray) -> None:
        """Act and let the simulation run for ``n_substeps``."""
        self.set_control(action)
        mujoco.mj_step(self.model, self.data, nstep=self.n_substeps)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, Info]:
        """Act for one step, and show it with ``render_mode="human"``."""
        result = super().step(action)
        if self.render_mode == "human":
            self.render()
        return result

    def render(self) -> np.ndarray | None:
        """Return a frame with the goal's markers; the simulation's state stays as it is.

        Shapes:
            result: ``(height, width, 3)``, uint8.
        """
        if self._renderer is None:
            from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

            width, height = self._frame_size
            self._renderer = MujocoRenderer(
                self.model, self.data, dict(self.camera), width=width, height=height
            )
        for name, place in self.goal_markers().items():
            # Sites of the world body are where the model says; data is what is drawn.
            self.data.site_xpos[self.site(name)] = place
            self.model.site_pos[self.site(name)] = place
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        """Free the window and the graphics memory."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def site(self, name: str) -> int:
        """Return the index of a site."""
        return int(self.model.site(name).id)

    def site_velocity(self, site: int) -> np.ndarray:
        """Return a site's angular (rad/s) and linear (m/s) velocity in world axes. Shapes: (6,)."""
        velocity = np.empty(6)
        kind = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(self.model, self.data, kind, site, velocity, 0)
        return velocity


def package_folder(package: str) -> Path:
    """Return the folder of an installed package without importing it."""
    spec = importlib.util.find_spec(package)
    assert spec is not None  # both packages that are asked for are required
    assert spec.origin is not None
    return Path(spec.origin).parent


def euler_angles(rotations: np.ndarray) -> np.ndarray:
    """Return the angles of rotations about x, then y, then z of the world, in rad.

    Args:
        rotations: Rotation matrices. Shapes: ``(..., 9)`` in row order; result: ``(..., 3)``.
    """
    matrix = np.asarray(rotations).reshape(*np.shape(rotations)[:-1], 3, 3)
    cos_y = np.hypot(matrix[..., 0, 0], matrix[..., 1, 0])
    return np.stack(
        [
            np.arctan2(matrix[..., 2, 1], matrix[..., 2, 2]),
            np.arctan2(-matrix[..., 2, 0], cos_y),
            np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0]),
        ],
        axis=-1,
    )
