"""Every environment can be put back into a scene of an episode and continues bit for bit."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.testing import environments
from scilab_rl.testing.scenes import assert_scenes_are_restored
from tests.contract.test_environments import FETCH, SHIPPED, SLOW


class Memory(gym.Wrapper):
    """Counts steps and adds up rewards, over all episodes and in this one."""

    def __init__(self, env):
        super().__init__(env)
        self.n_steps, self.total, self.rewards = 0, 0.0, []

    def reset(self, **arguments):
        self.rewards = []
        return self.env.reset(**arguments)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.n_steps += 1
        self.total = 0.9 * self.total + float(reward)
        self.rewards.append(float(reward))
        return observation, reward, terminated, truncated, {**info, "total": self.total}


@pytest.fixture(autouse=True)
def _registered():
    environments.register()


def _restored(env_id: str, **arguments: object) -> None:
    cfg = RunConfig(env_id, arguments, wrappers=[Memory])
    assert_scenes_are_restored(partial(make_single_env, cfg))


@pytest.mark.parametrize("env_id", [*SHIPPED, *FETCH, *SLOW])
def test_scenes_are_restored(env_id):
    _restored(env_id)


@pytest.mark.parametrize("env_id", [*environments.TINY_ENVIRONMENTS, "CartPole-v1"])
def test_scenes_of_other_simulators_are_replayed(env_id):
    _restored(env_id)


def test_the_step_limit_is_restored():
    _restored("FetchReach-v4", max_episode_steps=20)
