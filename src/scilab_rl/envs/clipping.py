"""Clipping actions without hiding their bounds."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from scilab_rl.errors import ConfigError


class ClipAction(gym.ActionWrapper):
    """Clips continuous actions into the environment's bounds, or into narrower ones.

    Gymnasium's wrapper of this name declares the action space unbounded, which no algorithm with
    squashed actions (SAC, TD3, DDPG) can work with; here the space stays as it is, or gets bounds
    where it has none.

    Args:
        env: An environment with Box actions.
        low: Lowest action in each dimension; the environment's own bound holds where it is higher.
        high: Highest action in each dimension.

    Raises:
        ConfigError: If the actions are not continuous, or no action is within these bounds.
    """

    def __init__(self, env: gym.Env, low: float = -np.inf, high: float = np.inf) -> None:
        if not isinstance(env.action_space, gym.spaces.Box):
            raise ConfigError(
                f"clip_action needs Box actions, but {env} has {type(env.action_space).__name__}."
            )
        super().__init__(env)
        space = env.action_space
        bounds = np.maximum(space.low, low), np.minimum(space.high, high)
        if (bounds[0] > bounds[1]).any():
            raise ConfigError(f"{env} has no actions from {low} to {high}: it has {space}.")
        if np.isfinite(low) or np.isfinite(high):
            self.action_space = gym.spaces.Box(*bounds, dtype=space.dtype.type)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the nearest allowed action."""
        space = self.action_space
        assert isinstance(space, gym.spaces.Box)
        return np.clip(action, space.low, space.high)
