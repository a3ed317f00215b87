"""Small algorithms in tiny environments, for all tests of this folder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.testing import environments


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)
    environments.register()


@pytest.fixture
def make_env() -> Callable[..., DummyVecEnv]:
    """Return a function that makes a vector environment from an id."""

    def make(env_id: str, n_envs: int = 1, **kwargs: Any) -> DummyVecEnv:
        return DummyVecEnv([lambda: gym.make(env_id, **kwargs) for _ in range(n_envs)])

    return make
