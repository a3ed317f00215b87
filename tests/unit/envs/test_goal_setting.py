"""Episodes with chosen goals, in every kind of environment, and side by side."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.config.compose import compose
from scilab_rl.envs.goal_setting import EpisodePlan
from scilab_rl.envs.vectorize import make_eval_env, make_single_env
from scilab_rl.metrics.success import success_of
from scilab_rl.training.evaluation import evaluate, evaluate_seeds, evaluate_side_by_side

GOALS = {
    "FetchPush-v4": [1.3, 0.8, 0.42],
    "FetchReach-v4": [1.4, 0.7, 0.5],
    "Reach1DOF-v0": [1.3],
    "PointMaze_Open-v3": [0.9, 1.1],
}


def plans_of(seeds, goal):
    return [[EpisodePlan(seed, goal)] for seed in seeds]


@pytest.mark.parametrize("env_id", GOALS)
def test_a_chosen_goal_is_that_of_the_whole_episode(env_id):
    env = make_single_env(compose([f"env={env_id}"]))
    goal = np.array(GOALS[env_id])
    drawn, _ = env.reset(seed=3)
    later = env.reset()[0]["desired_goal"]
    env.plan_episodes([EpisodePlan(3, goal), EpisodePlan(None, goal)])
    first, _ = env.reset()
    np.testing.assert_allclose(first["desired_goal"], goal, rtol=1e-6)
    # The start state and all later chance are those of the seed.
    np.testing.assert_array_equal(first["achieved_goal"], drawn["achieved_goal"])
    env.action_space.seed(0)
    step = env.step(env.action_space.sample())
    np.testing.assert_allclose(step[0]["desired_goal"], goal, rtol=1e-6)
    distance = np.linalg.norm(step[0]["achieved_goal"] - goal)
    assert step[1] == env.unwrapped.compute_reward(step[0]["achieved_goal"], goal, {})
    threshold = 0.45 if env_id.startswith("PointMaze") else 0.05
    assert success_of(step[4]) == (distance < threshold)
    assert not np.array_equal(later, goal)
    env.reset()
    env.plan_episodes([EpisodePlan(3)])
    np.testing.assert_array_equal(env.reset()[0]["desired_goal"], drawn["desired_goal"])
    np.testing.assert_array_equal(env.reset()[0]["desired_goal"], later)
    env.close()


def test_an_episode_with_a_chosen_goal_is_replayed():
    env = make_single_env(compose(["env=FetchReach-v4"]))
    env.plan_episodes([EpisodePlan(5, np.array(GOALS["FetchReach-v4"]))])
    env.reset()
    seen = [env.step(np.full(4, 0.3, np.float32))[0] for _ in range(3)]
    state = env.episode_state()
    env.reset(seed=9)
    again = env.replay_episode(state)
    for key, entry in seen[-1].items():
        np.testing.assert_array_equal(again[key], entry)
    env.close()


class Still:
    """Does nothing."""

    def __init__(self, env):
        self.env = env

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        n = len(next(iter(observation.values())))
        return np.zeros((n, *self.env.action_space.shape), np.float32), state


@pytest.mark.parametrize("env_id", ["FetchReach-v4", "scilab_rl.testing:TinyReach-v0"])
def test_seeds_side_by_side_play_the_episodes_of_each_alone(env_id):
    cfg = compose([f"env={env_id}"])
    together, alone = make_eval_env(cfg, n_envs=3), make_eval_env(cfg)
    seeds = [4, 5, 6]
    found = evaluate_seeds(Still(together), together, 2, seeds)
    for seed, evaluation in zip(seeds, found, strict=True):
        assert evaluation == evaluate(Still(alone), alone, 2, seed)
    together.close()
    alone.close()


def test_environments_with_fewer_episodes_wait():
    env = make_eval_env(compose(["env=scilab_rl.testing:TinyReach-v0"]), n_envs=2)
    told = []
    played = evaluate_side_by_side(
        Still(env), env, plans_of([1, 2], np.array([0.5, 0.5])), [3, 1], on_episode=told.append
    )
    assert [len(episodes) for episodes in played] == [3, 1] and len(told) == 4
    env.close()


def test_mujoco_is_stepped_by_threads():
    from scilab_rl.envs.threads import ThreadsVecEnv

    env = make_eval_env(compose(["env=FetchReach-v4"]), n_envs=2)
    assert isinstance(env.unwrapped, ThreadsVecEnv)
    env.close()


def test_environments_without_goals_are_left_alone():
    env = make_single_env(compose(["env=CartPole-v1"]))
    expected, _ = gym.make("CartPole-v1").reset(seed=1)
    env.plan_episodes([EpisodePlan(1, np.zeros(2))])
    np.testing.assert_array_equal(env.reset()[0], expected)
    env.close()
