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


def test_gives_bounds_where_there_are_none() -> None:
    env = gym.make("Pendulum-v1")
    env.action_space = gym.spaces.Box(np.float32([-np.inf]), np.float32([2.0]))
    narrow = ClipAction(env, low=-1, high=5)
    assert narrow.action_space == gym.spaces.Box(-1.0, 2.0, (1,))
    assert narrow.action(np.float32([-9])) == np.float32([-1])
    with pytest.raises(ConfigError, match="has no actions from 3 to 4"):
        ClipAction(env, low=3, high=4)
    env.close()


def test_refuses_discrete_actions() -> None:
    env = gym.make("CartPole-v1")
    with pytest.raises(ConfigError, match="needs Box actions"):
        ClipAction(env)
    env.close()
