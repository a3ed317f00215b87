import json

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.vectorize import make_single_env

ENVIRONMENTS = [
    "scilab_rl.testing:TinyReach-v0",
    "scilab_rl.testing:TinyDiscrete-v0",
    "Pendulum-v1",
]


def bits(value):
    if isinstance(value, dict):
        return {key: bits(entry) for key, entry in value.items()}
    return np.asarray(value).tobytes()


def act(env, n, seed):
    """Act for some steps, over the ends of episodes; return what was seen."""
    rng, seen = np.random.default_rng(seed), []
    for _ in range(n):
        space = env.action_space
        action = rng.integers(space.n) if hasattr(space, "n") else rng.uniform(-1, 1, space.shape)
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((bits(observation), float(reward), terminated, truncated))
        if terminated or truncated:
            seen.append(bits(env.reset()[0]))
    return seen


def interrupted(env_id, n_before):
    """Return the rest of an episode, with and without an interruption after some steps."""
    env = make_single_env(RunConfig(env_id))
    observation = env.reset(seed=3)[0]
    act(env, n_before, seed=1)
    state = env.episode_state()
    expected = act(env, 120, seed=2)
    env.close()
    other = make_single_env(RunConfig(env_id))
    other.reset(seed=99)
    observation = other.replay_episode(state)
    again = act(other, 120, seed=2)
    other.close()
    return observation, expected, again


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
@pytest.mark.parametrize("n_before", [0, 1, 7, 47])
def test_an_episode_goes_on_to_the_bit(env_id, n_before):
    _, expected, again = interrupted(env_id, n_before)
    assert again == expected


@pytest.mark.parametrize("n_before", [7, 73])
def test_fetch_goes_on_to_the_bit(n_before):
    _, expected, again = interrupted("FetchPush-v4", n_before)
    assert again == expected


def test_the_observation_of_that_place_is_returned():
    env = make_single_env(RunConfig(ENVIRONMENTS[0]))
    env.reset(seed=3)
    for _ in range(5):
        observation = env.step(np.array([0.3, -0.2]))[0]
    assert bits(env.replay_episode(env.episode_state())) == bits(observation)


def test_a_retold_episode_can_be_retold_again():
    env = make_single_env(RunConfig(ENVIRONMENTS[0]))
    env.reset(seed=3)
    act(env, 20, seed=1)
    state = env.episode_state()
    env.replay_episode(state)
    env.step(np.ones(2))
    longer = env.episode_state()
    assert len(longer["actions"]) == len(state["actions"]) + 1
    assert env.replay_episode(longer) is not None


def test_options_of_the_reset_are_repeated():
    class WithOptions(gym.Wrapper):
        def reset(self, *, seed=None, options=None):
            observation, info = self.env.reset(seed=seed)
            self.heard = options
            return observation, info

    env = RunEnv(WithOptions(gym.make("Pendulum-v1")))
    env.reset(seed=1, options={"start": 2})
    state = env.episode_state()
    env.env.heard = None
    env.replay_episode(state)
    assert env.env.heard == {"start": 2}


def test_the_generator_state_is_plain_data():
    env = make_single_env(RunConfig(ENVIRONMENTS[0]))
    env.reset(seed=1)
    env.reset()
    assert json.loads(json.dumps(env.episode_state()["generator_state"]))["state"]


def test_one_wrapper_of_ours_is_outside_of_those_of_the_user():
    env = make_single_env(RunConfig("FetchReach-v4", wrappers=[gym.wrappers.TimeAwareObservation]))
    assert isinstance(env, RunEnv)
    assert isinstance(env.env, gym.wrappers.TimeAwareObservation)
    assert list(env.wrapper_memory()) == ["TimeAwareObservation_1"]
    assert env.unknown_memory() == []
