"""Frames of exactly the step they belong to, also of the last step of an episode."""

from __future__ import annotations

import functools
import math
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.envs.pictures import PictureForm

DEFAULT_FPS = 25.0
FRAME_KEY = "scilab_rl.frame"
STATE_KEY = "scilab_rl.simulator_state"
_OF_CONTACTS = ("efc_", "iefc_", "contact")
CLOSE = "close"
NEARER = 0.58  # of the distance of a task's own camera
_BACKGROUND = (238, 240, 244)


class FrameCapture:
    """Renders after each reset and step while it is switched on, and puts the frame into ``info``.

    Vector environments reset a finished environment within the same call, so that a picture taken
    from outside would already show the next episode. The simulator's state is stored with it.

    A frame is ``(height, width, 3)`` in uint8, whatever the environment returns; where it cannot be
    drawn, it is the reason, as text, and the task continues.

    Args:
        env: An environment with ``render_mode="rgb_array"``.
        view: ``task``: as the task is drawn; ``close``: with a plain background, by a camera that
            is nearer. It changes pictures only.
    """

    def __init__(self, env: gym.Env, view: str = "task") -> None:
        self.env = env
        self._is_close = view == CLOSE
        self._wanted = self._capturing = False
        self._form = PictureForm()
        self._reason = ""  # why the first frame that is missing cannot be drawn
        self._is_broken = False

    def leave_out(self, reason: str) -> None:
        """Render nothing from now on, because it cannot be done here."""
        self._reason, self._is_broken = reason, True

    def capture(self, on: bool) -> None:
        """Switch capturing on, from the next reset, or off, at once."""
        self._wanted = on
        self._capturing = self._capturing and on

    @property
    def is_capturing(self) -> bool:
        """Whether the running episode is captured."""
        return self._capturing

    def begin_episode(self, info: dict[str, object]) -> None:
        """Add the first scene of an episode to the info of its reset."""
        self._capturing = self._wanted
        self.add_to(info)

    def add_to(self, info: dict[str, object]) -> None:
        """Add the scene after a step to its info."""
        if not self._capturing:
            return
        info[FRAME_KEY], memory = self._undisturbed_frame()
        if memory is not None:
            info[STATE_KEY] = memory.state

    def draw(self) -> np.ndarray | str:
        """Return a picture of the present scene, or why there is none."""
        return self._undisturbed_frame()[0]

    def _undisturbed_frame(self) -> tuple[np.ndarray | str, SimulatorMemory | None]:
        memory = simulator_memory(self.env)
        frame = self._frame()
        if memory is not None:
            # Fetch's renderer runs the constraint solver and moves all bodies to where they are
            # now, which would change the next step in the last bits: an episode that is watched
            # must be the one that is not.
            set_simulator_memory(self.env, memory)
        return frame, memory

    def _frame(self) -> np.ndarray | str:
        """Return a picture, or why there is none; the first reason stays, so that it is one."""
        if self._is_broken:
            return self._reason
        try:
            with warnings.catch_warnings():  # Gymnasium's own checks; we report what matters
                warnings.filterwarnings("ignore", r"(?s).*WARN: ", UserWarning)
                rendered = self._render()
        except Exception as error:  # noqa: BLE001 - whatever a renderer raises, learning continues
            self._is_broken = True  # it may be slow in failing, and is not asked again
            self._reason = self._reason or f"{type(error).__name__}: {error}"
            return self._reason
        try:
            return self._form.picture(rendered)
        except ValueError as error:
            self._reason = self._reason or str(error)
            return self._reason

    def _render(self) -> object:
        if self._is_close:
            self._is_close = False
            simplify_scene(self.env)  # before graphics memory gets its textures
            self.env.render()
            move_camera(self.env, NEARER)
        return self.env.render()


def simplify_scene(env: gym.Env) -> None:
    """Draw a MuJoCo task with a plain background and without the marks of its mocap bodies."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is None or not isinstance(
        model := getattr(env.unwrapped, "model", None), mujoco.MjModel
    ):
        return
    for texture in np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        n_channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
        n_pixels = int(model.tex_height[texture] * model.tex_width[texture])
        pixels = model.tex_data[start : start + n_pixels * n_channels].reshape(-1, n_channels)
        pixels[:, :3] = _BACKGROUND
    is_mocap = model.body_mocapid[model.geom_bodyid] >= 0
    model.geom_rgba[is_mocap, 3] = 0.0
    model.geom_matid[is_mocap] = -1


def move_camera(env: gym.Env, share: float) -> None:
    """Move the camera of a MuJoCo task to a share of its distance, once it has drawn a frame."""
    inner: Any = env.unwrapped
    renderer = getattr(inner, "mujoco_renderer", None) or getattr(inner, "_renderer", None)
    if (camera := getattr(getattr(renderer, "viewer", None), "cam", None)) is not None:
        camera.distance *= share


def frame_rate(metadata: Mapping[str, Any]) -> float:
    """Return the ``render_fps`` of an environment's metadata, or 25 where it says none.

    >>> [frame_rate(m) for m in ({"render_fps": 10}, {"render_fps": None}, {}, None)]
    [10.0, 25.0, 25.0, 25.0]
    """
    try:
        fps = float(metadata["render_fps"])
    except (KeyError, TypeError, ValueError):
        return DEFAULT_FPS
    return fps if math.isfinite(fps) and fps > 0 else DEFAULT_FPS


def simulator_state(env: gym.Env) -> np.ndarray | None:
    """Return all that MuJoCo needs to continue from here exactly, or None for other simulators."""
    mujoco, data = sys.modules.get("mujoco"), getattr(env.unwrapped, "data", None)
    if mujoco is None or not isinstance(data, mujoco.MjData):
        return None
    model, everything = env.unwrapped.model, int(mujoco.mjtState.mjSTATE_INTEGRATION)  # type: ignore[attr-defined]
    state = np.empty(mujoco.mj_stateSize(model, everything))
    mujoco.mj_getState(model, data, state, everything)
    return state


def set_simulator_state(env: gym.Env, state: np.ndarray) -> None:
    """Put MuJoCo back into a state from `simulator_state`."""
    import mujoco

    inner: Any = env.unwrapped
    mujoco.mj_setState(inner.model, inner.data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))


@dataclass(frozen=True)
class SimulatorMemory:
    """All that MuJoCo holds, with what follows from its state.

    An action may depend on what was derived before the last substep, such as the place of a body,
    so that a forward pass from the state is not the same.

    Attributes:
        state: From `simulator_state`.
        derived: All other arrays of its data, by name.
        warnings: Its counters of warnings.
        sites: Where the model has its sites, which renderers move to mark goals. Shapes:
            ``(n_sites, 3)``.
    """

    state: np.ndarray
    derived: dict[str, np.ndarray]
    warnings: np.ndarray
    sites: np.ndarray


def simulator_memory(env: gym.Env) -> SimulatorMemory | None:
    """Return all that MuJoCo holds, or None for other simulators."""
    state = simulator_state(env)
    if state is None:
        return None
    inner: Any = env.unwrapped
    data = inner.data
    derived = {name: np.array(getattr(data, name)) for name in _derived_names()}
    return SimulatorMemory(
        state, derived, np.array(data.warning.number), inner.model.site_pos.copy()
    )


def set_simulator_memory(env: gym.Env, memory: SimulatorMemory) -> None:
    """Put MuJoCo back to where `simulator_memory` was taken, here or in a copy of the task."""
    set_simulator_state(env, memory.state)
    inner: Any = env.unwrapped
    inner.data.warning.number[:] = memory.warnings
    inner.model.site_pos[:] = memory.sites
    for name, values in memory.derived.items():
        if (array := getattr(inner.data, name)).shape == values.shape:
            array[...] = values


@functools.cache
def _derived_names() -> list[str]:
    """Return the names of MuJoCo's arrays, but for those that each step computes anew."""
    import mujoco

    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    return [
        name
        for name in dir(data)
        if not name.startswith(("_", *_OF_CONTACTS))
        and isinstance(array := getattr(data, name), np.ndarray)
        and array.flags.writeable
    ]
