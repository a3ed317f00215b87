from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.checker import check_environment
from scilab_rl.envs.slices import GoalFromSlices
from scilab_rl.errors import ConfigError
from scilab_rl.testing.environments import TinyBox


def make(**arguments) -> gym.Env:
    """TinyBox observes the place of a point and then its goal, two numbers each."""
    slices = {"achieved": [0, 2], "desired": [2, 4], "threshold": 0.5}
    return GoalFromSlices(TinyBox(), **(slices | arguments))


def test_observation_is_split_and_paid_by_distance() -> None:
    env = make()
    observation, info = env.reset(seed=0)
    vector = observation["observation"]
    assert np.array_equal(observation["achieved_goal"], vector[:2])
    assert np.array_equal(observation["desired_goal"], vector[2:])
    assert info["is_success"] == (np.linalg.norm(vector[:2] - vector[2:]) <= 0.5)
    observation, reward, _, _, info = env.step(np.zeros(2, np.float32))
    distance = np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"])
    assert (reward == 0.0) == info["is_success"] == (distance <= 0.5)
    assert np.isclose(info["own_reward"], -distance)


def test_rewards_of_a_batch_by_hand() -> None:
    achieved, desired = np.zeros((2, 2)), np.array([[0.3, 0.4], [0.6, 0.8]])
    assert make().compute_reward(achieved, desired, {}).tolist() == [0.0, -1.0]
    assert np.allclose(make(reward_type="dense").compute_reward(achieved, desired, {}), [-0.5, -1])
    ends = make(terminate_on_success=True).compute_terminated(achieved, desired, {})
    assert ends.tolist() == [True, False]


def test_the_doctor_finds_no_fault() -> None:
    limited = lambda: gym.wrappers.TimeLimit(make(), 30)  # noqa: E731
    found = [finding for finding in check_environment(limited, n_steps=300)]
    assert [f for f in found if f.result == "fail"] == []
    assert "rewards of a batch" in {finding.check for finding in found}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"achieved": [0, 5]}, r"achieved must be \[from, to\] with 0 <= from < to <= 4"),
        ({"desired": [2, 2]}, "desired must be"),
        ({"desired": [2, 3]}, "differ in length"),
        ({"reward_type": "spares"}, "Did you mean 'sparse'"),
    ],
)
def test_wrong_slices(arguments, message) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**arguments)


def test_needs_a_vector() -> None:
    with pytest.raises(ConfigError, match="needs a vector observation"):
        GoalFromSlices(gym.make("FrozenLake-v1"), [0, 1], [1, 2], 0.1)
