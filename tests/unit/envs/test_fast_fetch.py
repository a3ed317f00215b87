from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.checker import equal
from scilab_rl.envs.fast_fetch import RememberedLookups, euler_angles, speed_up
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.vectorize import make_single_env

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


def test_actions_of_double_precision_are_equal_too() -> None:
    for env_id in FETCH:
        fast, original = make_pair(env_id)
        fast.reset(seed=1), original.reset(seed=1)
        for _ in range(5):
            action = np.full(4, 0.1)  # which single precision cannot hold
            assert equal(fast.step(action), original.step(action))


def test_angles_are_equal_to_the_last_bit() -> None:
    from gymnasium_robotics.utils.rotations import mat2euler

    matrices = list(np.linalg.qr(np.random.default_rng(0).normal(size=(2000, 3, 3)))[0])
    for angle in np.linspace(-np.pi, np.pi, 50):  # about y, up to where the others are lost
        c, s = np.cos(angle), np.sin(angle)
        matrices.append(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    matrices += [np.array([[0, 0, s], [0, 1, 0], [-s, 0, 0.0]]) for s in (1.0, -1.0)]
    matrices += [np.array([[0, 0, 1], [s, 0.6, 0], [-0.6, s, 0.0]]) for s in (0.8, -0.8)]
    for matrix in matrices:
        ours, theirs = euler_angles(matrix.reshape(9)), mat2euler(matrix)
        assert ours.tobytes() == theirs.tobytes()


def test_dense_rewards_and_their_types_are_equal_too() -> None:
    for kwargs in ({"reward_type": "dense"}, {}):
        fast, original = (gym.make("FetchPush-v4", **kwargs) for _ in range(2))
        assert speed_up(fast)
        fast.reset(seed=1), original.reset(seed=1)
        for _ in range(3):
            result, expected = fast.step(np.ones(4)), original.step(np.ones(4))
            assert repr(result) == repr(expected)  # also -0.0 and its precision
    for env in (fast, original):
        with pytest.raises(ValueError, match="Action dimension mismatch"):
            env.step(np.ones(3))


def test_what_a_subclass_observes_stays() -> None:
    from gymnasium_robotics.envs.fetch.push import MujocoFetchPushEnv

    class Blind(MujocoFetchPushEnv):
        def _get_obs(self):
            return {key: 0 * entry for key, entry in super()._get_obs().items()}

    env = Blind()
    assert speed_up(env)
    env.reset(seed=1)
    assert not env.step(np.ones(4))[0]["observation"].any()


def test_on_by_default_and_off_with_one_key() -> None:
    env = make_single_env(RunConfig("FetchReach-v4"))
    assert isinstance(env.unwrapped._utils, RememberedLookups)
    env = make_single_env(RunConfig("FetchReach-v4", fast_fetch=False))
    assert not isinstance(env.unwrapped._utils, RememberedLookups)


def test_others_are_left_alone() -> None:
    assert not speed_up(gym.make("CartPole-v1"))
    assert not speed_up(gym.make(resolve_env_id("PointGym-v0")[0]))
