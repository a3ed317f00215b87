"""Frames of exactly the step they belong to, also of the last step of an episode."""

from __future__ import annotations

import logging
from typing import Any

import gymnasium as gym
import numpy as np

_log = logging.getLogger(__name__)
FRAME_KEY = "scilab_rl.frame"


class FrameCapture(gym.Wrapper):
    """Renders after each reset and step while it is switched on, and puts the frame into ``info``.

    Vector environments reset a finished environment within the same call, so that a picture taken
    from outside would already show the next episode.

    Args:
        env: An environment with ``render_mode="rgb_array"``.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.capturing = False

    def capture_frames(self, on: bool) -> None:
        """Switch capturing on or off."""
        self.capturing = on

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        """Reset and render."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._with_frame(info)

    def step(self, action: Any) -> Any:
        """Step and render."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, self._with_frame(info)

    def _with_frame(self, info: dict[str, Any]) -> dict[str, Any]:
        if not self.capturing:
            return info
        try:
            return {**info, FRAME_KEY: np.asarray(self.env.render())}
        except Exception as error:  # noqa: BLE001 - whatever a renderer raises, learning goes on
            self.capturing = False
            _log.warning("Rendering is switched off: %s: %s", type(error).__name__, error)
            return info
