"""Extrinsic and intrinsic return are kept apart, also at the end of an episode."""

import numpy as np
import pytest

from scilab_rl.envs.vec_step import ObservedStep, decode_step
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.training.statistics import RolloutStatistics


class WithIntrinsicReward:
    """Rewards each step with where it led."""

    def intrinsic_rewards(self, observations, actions, next_observations):
        return next_observations[:, 0]


def step(rewards, led_to, dones, terminal):
    infos = [{"terminal_observation": np.array([entry])} for entry in terminal]
    zeros = np.zeros(2, dtype=np.int64)
    observations = np.zeros((2, 1))
    decoded = decode_step(
        observations, np.zeros((2, 1)), np.array(led_to)[:, None], np.array(rewards),
        np.array(dones), infos,
    )  # fmt: skip
    nothing = [None, None]
    return ObservedStep(**vars(decoded), phase="train", step=2, episodes=zeros,
                        episode_steps=zeros, frames=nothing, states=nothing)  # fmt: skip


def test_both_returns_are_logged_apart():
    logger, episodes = MetricLogger(), []
    statistics = RolloutStatistics(logger, 2, episodes.append, inspector=WithIntrinsicReward())
    statistics.on_step(step([-1.0, -1.0], [10.0, 20.0], [False, False], [0.0, 0.0]))
    assert logger.take()["train/intrinsic_reward_step"] == 10.0
    # The first environment's episode ends in 5; 99 is the first observation of the next one.
    statistics.on_step(step([0.0, -1.0], [99.0, 30.0], [True, False], [5.0, 0.0]))
    assert logger.take()["train/intrinsic_reward_step"] == 5.0
    metrics = statistics.metrics()
    assert metrics["rollout/ep_rew_mean"] == -1.0
    assert metrics["rollout/intrinsic_ep_rew_mean"] == 15.0
    assert (episodes[0]["reward"], episodes[0]["intrinsic_reward"]) == (-1.0, 15.0)
    assert statistics.intrinsic_returns.tolist() == [0.0, 50.0]


def test_without_curiosity_nothing_is_logged_about_it():
    logger, episodes = MetricLogger(), []
    statistics = RolloutStatistics(logger, 2, episodes.append)
    statistics.on_step(step([0.0, 0.0], [1.0, 1.0], [True, True], [1.0, 1.0]))
    assert not any("intrinsic" in name for name in (*logger.take(), *statistics.metrics()))
    assert "intrinsic_reward" not in episodes[0]
    assert statistics.metrics()["rollout/ep_rew_mean"] == pytest.approx(0.0)
