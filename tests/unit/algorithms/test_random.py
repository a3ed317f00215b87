from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.algorithms.random import RANDOM
from scilab_rl.canonical_spaces import conversions, with_canonical_spaces


class AnyActions(gym.Env):
    observation_space = spaces.Box(-1, 1, (1,))

    def __init__(self, action_space: spaces.Space) -> None:
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(np.asarray(action))
        return np.zeros(1, np.float32), 0.0, False, False, {}


SPACES = [
    spaces.Box(np.float32([-3.0, 1.0]), np.float32([-2.0, 5.0])),
    spaces.Discrete(4, start=3),
    spaces.MultiDiscrete([2, 5]),
    spaces.MultiDiscrete([[2, 3], [2, 3]], start=[[1, 1], [0, -4]]),
    spaces.Box(-128, 127, (2,), np.int8),
    spaces.Box(0, 0.25, (), np.float16),
    spaces.MultiBinary(3),
]


def make(space: spaces.Space, n_envs: int = 2) -> RANDOM:
    env = with_canonical_spaces(DummyVecEnv([lambda: AnyActions(space)] * n_envs))
    return RANDOM(env=env, seed=4, device="cpu")


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_actions_of_any_kind_are_in_the_space(space: spaces.Space) -> None:
    model = make(space).learn(20)
    assert model.num_timesteps == 20
    batch, _ = model.predict(np.zeros((30, 1), np.float32), deterministic=True)
    assert len(batch) == 30
    batch = conversions(model.get_env())[0].to_env(batch)
    for action in batch:
        assert space.contains(np.asarray(action, space.dtype))
    assert len(np.unique(batch, axis=0)) > 3


def test_actions_cover_the_range_evenly() -> None:
    model = make(SPACES[0])
    actions, _ = model.predict(np.zeros((4000, 1), np.float32))
    np.testing.assert_allclose(actions.mean(axis=0), [-2.5, 3.0], atol=0.1)
    np.testing.assert_allclose(actions.min(axis=0), [-3.0, 1.0], atol=0.01)


def test_a_seed_determines_the_actions() -> None:
    observations = np.zeros((5, 1), np.float32)
    first, second = (make(SPACES[0]).predict(observations)[0] for _ in range(2))
    assert first.tolist() == second.tolist()
