from __future__ import annotations

import itertools

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.mazes import MAPS, AntMaze, PointMaze, PointObjMaze, cell_centers
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError


def test_long_ids_give_every_option() -> None:
    ant = gym.make(resolve_env_id("AntGym-sparseneg-10-1.5-small_open_dgr-c0-rt0-s700-v0")[0])
    env = ant.unwrapped
    assert ant.spec.max_episode_steps == 700
    assert (env.n_substeps, env.threshold, env.reward_type) == (10, 1.5, "sparseneg")
    assert env.terminate_on_success
    point = gym.make(resolve_env_id("PointObjGym-sparse-o4-0.5-open_dgr-c1-rt1-s300-v0")[0])
    env = point.unwrapped
    assert (env.n_objects, env.threshold, env.reset_target) == (4, 0.5, True)
    assert len(env.starts) == 15


AGENTS = {"PointGym": "", "PointObjGym": "-o2", "AntGym": "-10"}
REWARDS = ("sparse", "sparseneg", "dense")


@pytest.mark.parametrize("agent", AGENTS)
def test_every_long_id_of_the_reference_names_a_maze(agent: str) -> None:
    """All words of the grammar; each way to continue is also made."""
    endings = list(itertools.product(REWARDS, MAPS, (0, 1), (0, 1)))
    for number, (reward, maze_map, continuing, reset) in enumerate(endings):
        given = f"{agent}-{reward}{AGENTS[agent]}-1.5-{maze_map}-c{continuing}-rt{reset}-s300-v0"
        found, notice = resolve_env_id(given)
        kwargs = gym.spec(found).kwargs
        assert (found, gym.spec(found).max_episode_steps) == (given, 300)
        assert kwargs["continuing"] is bool(continuing)
        assert kwargs["reset_target"] is bool(continuing and reset)
        assert notice and f"reset_target={bool(continuing and reset)}" in notice
        if number % 23 == 0 or (reward, maze_map) == ("sparseneg", "small_open_dgr"):
            env = gym.make(found)
            env.reset(seed=1)
            env.step(env.action_space.sample())
            env.close()


def test_the_id_that_was_refused() -> None:
    found, _ = resolve_env_id("AntGym-sparseneg-10-1.5-small_open_dgr-c0-rt1-s300-v0")
    env = gym.make(found)
    assert env.unwrapped.terminate_on_success and not env.unwrapped.reset_target


@pytest.mark.parametrize("threshold", ["1", "0.50", ".5", "2."])
def test_thresholds_are_numbers(threshold: str) -> None:
    found, _ = resolve_env_id(f"PointGym-sparse-{threshold}-open_dgr-c1-rt0-s10-v0")
    assert gym.make(found).unwrapped.threshold == float(threshold)


@pytest.mark.parametrize("reset_target", [False, True])
def test_a_threshold_that_leaves_no_goal_is_refused(reset_target: bool) -> None:
    """It would be looked for without end."""
    with pytest.raises(ConfigError, match="too large for this map"):
        PointMaze("small_open_dgr", threshold=4.0, reset_target=reset_target)
    PointMaze("small_open_dgr", threshold=1.5, reset_target=reset_target).reset(seed=1)


@pytest.mark.parametrize("wrong", ["PointGym-sparse-0.5-big-c1-rt0-s500-v0", "AntGym-sparse-v0"])
def test_wrong_long_ids_show_the_maps(wrong) -> None:
    with pytest.raises(ConfigError, match="MAP one of open, open_dg"):
        resolve_env_id(wrong)


def test_rewards_by_hand() -> None:
    achieved, desired = np.zeros((3, 2)), np.array([[0.3, 0.4], [0.6, 0.8], [0.0, 0.0]])
    expected = {"sparse": [1, 0, 1], "sparseneg": [0, -1, 0], "dense": np.exp([-0.5, -1, 0])}
    for reward_type, rewards in expected.items():
        env = PointMaze(reward_type=reward_type, threshold=0.5)
        assert np.allclose(env.compute_reward(achieved, desired, {}), rewards)


def test_cells_are_where_the_map_shows_them() -> None:
    assert cell_centers(("#r#", "#.g"), "r", 2.0).tolist() == [[0.0, 1.0]]
    assert cell_centers(("#r#", "#.g"), "g", 2.0).tolist() == [[2.0, -1.0]]
    assert len(cell_centers(MAPS["open"], "rc", 1.0)) == 15


@pytest.mark.parametrize("maze_map", list(MAPS))
def test_starts_and_goals_are_apart_and_inside(maze_map) -> None:
    env = PointMaze(maze_map)
    for seed in range(50):
        observation, info = env.reset(seed=seed)
        assert not info["is_success"]
        for key, cells in (("achieved_goal", env.starts), ("desired_goal", env.goals)):
            assert np.abs(cells - observation[key]).max(axis=1).min() <= 0.25 + 1e-6


def test_walls_stop_the_point_and_its_speed_is_limited() -> None:
    env = PointMaze(["####", "#rg#", "####"])
    env.reset(seed=0)
    for _ in range(300):
        observation = env.step(np.array([1.0, 1.0]))[0]
    assert np.all(observation["achieved_goal"] < [1.0, 0.5])
    assert np.abs(env.data.qvel).max() < 5.5


def test_objects_can_be_pushed() -> None:
    env = PointObjMaze("small_open_dgr", n_objects=1)
    env.reset(seed=0)
    env.data.qpos[:] = [-1.0, 0.0, 0.0, 0.0]
    for _ in range(60):
        env.step(np.array([1.0, 0.0]))
    assert env.data.qpos[2] > 0.2
    assert env.data.qpos[2] > env.data.qpos[0]


def test_reached_goal_is_followed_by_another() -> None:
    env = PointMaze(reset_target=True, threshold=0.5)
    before = env.reset(seed=0)[0]["desired_goal"]
    env.data.qpos[:2] = before
    observation, reward, terminated, _, info = env.step(np.zeros(2))
    assert (reward, terminated, info["is_success"]) == (1.0, False, True)
    assert np.array_equal(observation["desired_goal"], before)
    assert not np.array_equal(env.step(np.zeros(2))[0]["desired_goal"], before)


def test_ant_falls_on_its_feet_and_feels_itself() -> None:
    env = AntMaze()
    observation, _ = env.reset(seed=0)
    assert observation["observation"].shape == (27,)
    for _ in range(20):
        observation = env.step(np.zeros(8))[0]
    assert 0.2 < observation["observation"][0] < 0.8


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"maze_map": "smal_open_dgr"}, "Did you mean 'small_open_dgr'"),
        ({"maze_map": ["##", "#"]}, "rows of equal length"),
        ({"maze_map": ["#r#"]}, "has no goals"),
        ({"maze_map": ["#c#"]}, "in another cell"),
        ({"reset_target": True, "continuing": False}, "needs env_kwargs.continuing=true"),
        ({"n_objects": 9}, "n_objects must be one of 0, 1"),
    ],
)
def test_wrong_options(wrong, message) -> None:
    with pytest.raises(ConfigError, match=message):
        PointMaze(**wrong)
