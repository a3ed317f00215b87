from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.checker import course, equal
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.testing.goal_environments import EnvironmentContract


class Panda(EnvironmentContract):
    n_steps = 100

    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        pytest.importorskip("panda_gym")


class TestReach(Panda):
    env = "PandaReach-v3"


class TestPush(Panda):
    env = "PandaPush-v3"

    def test_an_episode_does_not_depend_on_earlier_ones(self) -> None:
        env = gym.make(resolve_env_id(self.env)[0])
        first = course(env, seed=1)
        course(env, seed=2)
        assert equal(course(env, seed=1), first)

    def test_goals_without_a_seed_follow_from_the_last_one(self) -> None:
        env = gym.make(resolve_env_id(self.env)[0])
        goals = []
        for _ in range(2):
            env.reset(seed=5)
            goals.append([env.reset()[0]["desired_goal"] for _ in range(3)])
        assert np.array_equal(*goals)
        assert len({goal.tobytes() for goal in goals[0]}) == 3


class TestStack(Panda):
    env = "PandaStack-v3"
