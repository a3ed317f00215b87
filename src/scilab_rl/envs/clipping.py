"""Clipping actions without hiding their bounds."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.errors import ConfigError


class ClipAction(gym.ActionWrapper):
    """Clips continuous actions into the environment's bounds.

    Gymnasium's wrapper of this name declares the action space unbounded, which no algorithm with
    squashed actions (SAC, TD3, DDPG) can work with; here the space stays as it is.

    Args:
        env: An environment with Box actions.

    Raises:
        ConfigError: If the actions are not continuous.
    """

    def __init__(self, env: gym.Env) -> None:
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ConfigError(
                f"clip_action needs Box actions, but {env} has {type(env.action_space).__name__}."
            )
        super().__init__(env)

    def action(self, action: Any) -> np.ndarray:
        """Return the nearest allowed action."""
        space = self.env.action_space
        assert isinstance(space, gym.spaces.Box)
        return np.clip(action, space.low, space.high)
