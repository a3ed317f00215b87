"""Frames of exactly the step they belong to, also of the last step of an episode."""

from __future__ import annotations

import logging
import sys
from typing import Any

import gymnasium as gym
import numpy as np

_log = logging.getLogger(__name__)
FRAME_KEY = "scilab_rl.frame"
STATE_KEY = "scilab_rl.simulator_state"


class FrameCapture(gym.Wrapper):
    """Renders after each reset and step while it is switched on, and puts the frame into ``info``.

    Vector environments reset a finished environment within the same call, so that a picture taken
    from outside would already show the next episode. The simulator's state is put beside it.

    Args:
        env: An environment with ``render_mode="rgb_array"``.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.wanted = False
        self.capturing = False

    def capture_frames(self, on: bool) -> None:
        """Switch capturing on, from the next reset, or off, at once."""
        self.wanted = on
        self.capturing = self.capturing and on

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        """Reset and render."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.capturing = self.wanted
        return observation, self._with_frame(info)

    def step(self, action: Any) -> Any:
        """Step and render."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, self._with_frame(info)

    def _with_frame(self, info: dict[str, Any]) -> dict[str, Any]:
        if not self.capturing:
            return info
        state = simulator_state(self.env)
        try:
            frame = np.asarray(self.env.render())
        except Exception as error:  # noqa: BLE001 - whatever a renderer raises, learning goes on
            self.capturing = self.wanted = False
            _log.warning("Rendering is switched off: %s: %s", type(error).__name__, error)
            return info
        if state is None:
            return {**info, FRAME_KEY: frame}
        # Fetch's renderer runs the constraint solver, which would change the next step in the last
        # bits: an episode that is watched must be the one that is not.
        set_simulator_state(self.env, state)
        return {**info, FRAME_KEY: frame, STATE_KEY: state}


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
