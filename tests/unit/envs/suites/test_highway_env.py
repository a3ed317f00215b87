from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.testing.goal_environments import EnvironmentContract


class TestParking(EnvironmentContract):
    env = "parking-limited-v0"
    n_steps = 200
    accepted = ("infos of relabeled goals",)  # its shipped values have info_keys=[crashed]

    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        pytest.importorskip("highway_env")

    def test_a_crash_costs_and_ends_in_relabeled_goals_too(self) -> None:
        env = gym.make(resolve_env_id(self.env)[0]).unwrapped
        goals, infos = np.zeros((2, 6)), [{"crashed": True}, {"crashed": False}]
        desired = np.array([[0.0] * 6, [0.25, 0, 0, 0, 0, 0]])
        assert env.compute_reward(goals, desired, infos).tolist() == [-5.0, -0.5]
        assert env.compute_terminated(goals, desired, infos).tolist() == [True, False]
        assert env.compute_terminated(goals[0], goals[0], {})  # parked
        assert gym.spec(self.env).max_episode_steps == 100

    def test_observations_are_those_of_the_original(self) -> None:
        ours, original = gym.make(self.env), gym.make("parking-v0", max_episode_steps=100)
        actions = np.random.default_rng(1).uniform(-1, 1, (300, 2)).astype(np.float32)
        pairs = [(ours.reset(seed=3), original.reset(seed=3))]
        for action in actions:
            pairs.append((ours.step(action), original.step(action)))
            if any(pairs[-1][1][2:4]):
                pairs.append((ours.reset(), original.reset()))
        assert len(pairs) > 301  # over the end of an episode
        for (mine, *mine_rest), (theirs, *theirs_rest) in pairs:
            assert {key: entry.tolist() for key, entry in mine.items()} == {
                key: entry.tolist() for key, entry in theirs.items()
            }
            assert mine_rest[:-1] == theirs_rest[:-1]
        ours.close()
        original.close()
