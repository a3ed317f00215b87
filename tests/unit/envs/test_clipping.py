from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.clipping import ClipAction
from scilab_rl.errors import ConfigError


def test_clips_and_keeps_the_bounds() -> None:
    env = ClipAction(gym.make("Pendulum-v1"))
    assert env.action_space == env.unwrapped.action_space
    clipped = env.action(np.array([7.0], dtype=np.float32))
    assert clipped == np.array([2.0], dtype=np.float32)
    env.close()


def test_refuses_discrete_actions() -> None:
    env = gym.make("CartPole-v1")
    with pytest.raises(ConfigError, match="needs Box actions"):
        ClipAction(env)
    env.close()
