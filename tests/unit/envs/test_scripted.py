"""Scripted controllers solve what they are for: `run.demonstrations` keeps their successes."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.scripted import PointMaze, controller_for
from scilab_rl.errors import ConfigError

# Of 100 episodes, seeds 0 to 99: all but FetchSlide in every one, FetchSlide in 40.
ALWAYS = [
    "FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4", "Blocks-o1-gripper_none-v1",
    "Blocks-o1-gripper_above-v1", "Blocks-o1-gripper_random-v1",
    "PointGym-sparse-0.5-small_open_dgr-c1-rt0-s500",
]  # fmt: skip


def successes(env_id: str, seeds: range) -> int:
    env = gym.make(resolve_env_id(env_id)[0])
    controller, found = controller_for(env), 0
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        controller.begin()
        is_over = False
        while not is_over:
            action = controller.act(observation).astype(env.action_space.dtype)
            assert env.action_space.contains(action)
            observation, _, terminated, truncated, info = env.step(action)
            is_over = terminated or truncated
        found += bool(info["is_success"])
    env.close()
    return found


@pytest.mark.parametrize("env_id", ALWAYS)
def test_it_succeeds(env_id: str) -> None:
    assert successes(env_id, range(2)) == 2


def test_a_third_of_the_strikes_arrive() -> None:
    assert 1 <= successes("FetchSlide-v4", range(8)) <= 7


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ALWAYS)
def test_it_succeeds_always(env_id: str) -> None:
    assert successes(env_id, range(100)) >= 99


@pytest.mark.slow
def test_how_often_a_strike_arrives() -> None:
    assert 25 <= successes("FetchSlide-v4", range(100)) <= 55


def test_a_path_leads_around_walls() -> None:
    class Map:
        rows = ("#####", "#.#.#", "#...#", "#####")
        cell_size = 1.0

    maze = PointMaze(Map)
    assert maze._path((1, 1), (3, 1)) == [(1, 1), (1, 2), (2, 2), (3, 2), (3, 1)]
    assert maze._path((1, 1), (0, 0)) == [(1, 1)]
    # The map's middle is the origin: column 1 of 5 is x = -1, row 1 of 4 is y = 0.5.
    assert maze._cell(np.array([-1.0, 0.5])) == (1, 1)
    place = {"achieved_goal": np.array([-1.0, 0.5]), "desired_goal": np.array([1.0, 0.5]),
             "observation": np.array([-1.0, 0.5, 0.0, 0.1])}  # fmt: skip
    # Down to the next cell: 4 * (0, -1) - 2 * (0, 0.1), clipped.
    assert maze.act(place).tolist() == [0.0, -1.0]


def test_a_task_without_a_controller_says_which_have_one() -> None:
    with pytest.raises(ConfigError, match=r"no scripted controller for CartPole-v1.*FetchReach"):
        controller_for(gym.make("CartPole-v1"))
