from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.examination import equal
from scilab_rl.envs.fast_fetch import RememberedLookups, speed_up
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.vectorize import EnvSettings, make_single_env

FETCH = ("FetchReach", "FetchPush", "FetchPickAndPlace", "FetchSlide")


def make_pair(env_id: str) -> tuple[gym.Env, gym.Env]:
    env_id = resolve_env_id(env_id)[0]
    fast, original = gym.make(env_id), gym.make(env_id)
    assert speed_up(fast)
    return fast, original


def compare(fast: gym.Env, original: gym.Env, n_steps: int) -> None:
    rng = np.random.default_rng(0)
    assert equal(fast.reset(seed=1), original.reset(seed=1))
    for _ in range(n_steps):
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        result, expected = fast.step(action), original.step(action)
        assert equal(result, expected)
        if result[3]:
            assert equal(fast.reset(), original.reset())


@pytest.mark.parametrize("env_id", FETCH)
def test_steps_are_equal_to_the_last_bit(env_id) -> None:
    compare(*make_pair(env_id), n_steps=200)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", FETCH)
def test_ten_thousand_steps_are_equal_to_the_last_bit(env_id) -> None:
    compare(*make_pair(env_id), n_steps=10_000)


def test_on_by_default_and_off_with_one_key() -> None:
    env = make_single_env(EnvSettings("FetchReach-v4"))
    assert isinstance(env.unwrapped._utils, RememberedLookups)
    env = make_single_env(EnvSettings("FetchReach-v4", fast_fetch=False))
    assert not isinstance(env.unwrapped._utils, RememberedLookups)


def test_others_are_left_alone() -> None:
    assert not speed_up(gym.make("CartPole-v1"))
    assert not speed_up(gym.make(resolve_env_id("PointGym-v0")[0]))
