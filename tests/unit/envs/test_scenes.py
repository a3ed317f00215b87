from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.mujoco_goal import MujocoGoalEnv
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.scenes import (
    EpisodeScenes,
    change_goal,
    is_equal,
    start_as_text,
    start_from_text,
)
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.errors import ConfigError
from scilab_rl.testing import environments

_XML = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="x" type="slide"
axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
<actuator><motor joint="x"/></actuator></mujoco>"""


class Slider(MujocoGoalEnv):
    """A mass on a rail; with a secret, an object counts steps and changes the observation."""

    action_size = 1

    def __init__(self, *, secret=False):
        self.secret = SimpleNamespace(n=0, is_used=secret)
        super().__init__(_XML, n_substeps=5)

    def reset_state(self):
        self.secret.n = 0
        super().reset_state()

    def sample_goal(self):
        return self.np_random.uniform(-1, 1, 1)

    def apply_action(self, action):
        self.secret.n += self.secret.is_used
        super().apply_action(action)

    def achieved_goal(self):
        return self.data.qpos

    def get_observation(self):
        return np.array([self.data.qpos[0], self.data.qvel[0], self.secret.n])


def _episode(env, n=10):
    env.reset(seed=3)
    actions = list(env.np_random.uniform(-1, 1, (n, 1)))
    return EpisodeScenes(env, env.episode_start(), actions)


def test_a_scene_is_put_into_another_instance():
    scenes, other = _episode(RunEnv(Slider())), RunEnv(Slider())
    other.reset(seed=4)
    assert scenes.check_snapshots(other, [0, 5])
    assert is_equal(scenes.put(other, 5), scenes.observations[5])
    np.testing.assert_array_equal(other.unwrapped.goal, scenes.observations[0]["desired_goal"])
    assert len(other.episode_state()["actions"]) == 5
    assert len(scenes) == 11


def test_a_snapshot_that_is_not_enough_is_noticed_and_the_episode_replayed():
    scenes, other = _episode(RunEnv(Slider(secret=True))), RunEnv(Slider(secret=True))
    other.reset(seed=4)
    assert scenes.is_fast
    assert not scenes.check_snapshots(other, [5])
    assert scenes.put(other, 5)["observation"][2] == 5


def test_an_episode_that_cannot_be_repeated_is_refused():
    env = RunEnv(Slider())
    scenes = _episode(env)
    expected = [dict(observation) for observation in scenes.observations]
    expected[4] = {**expected[4], "observation": expected[4]["observation"] + 1e-6}
    actions = list(env.episode_state()["actions"])
    with pytest.raises(ConfigError, match=r"scene 4 of .* differs"):
        EpisodeScenes(env, env.episode_start(), actions, expected)


def test_the_start_of_an_episode_survives_as_text():
    goal = np.array([0.1, 1 / 3], np.float32)
    start = {
        "reset_arguments": {"seed": None, "options": {"desired_goal": goal}},
        "generator_state": np.random.default_rng(5).bit_generator.state,
        "memory": {"Wrapper_1": {"mean": ["array", np.array([1 / 3, np.nan])], "n": 3}},
    }
    again = start_from_text(start_as_text(start))
    np.testing.assert_equal(again, start)
    assert again["reset_arguments"]["options"]["desired_goal"].dtype == np.float32


def test_the_goal_is_changed_in_the_middle():
    env = RunEnv(Slider())
    observation, _ = env.reset(seed=1)
    changed = change_goal(env, observation, np.array([0.25]))
    assert changed["desired_goal"] == [0.25]
    assert env.step(np.zeros(1))[0]["desired_goal"] == [0.25]


def test_a_goal_of_another_size_or_in_a_task_without_goals_is_refused():
    environments.register()
    env = RunEnv(Slider())
    with pytest.raises(ConfigError, match=r"The goal has 1 numbers .*but 2 were given"):
        change_goal(env, env.reset(seed=1)[0], np.zeros(2))
    plain = make_single_env(RunConfig("TinyBox-v0", {}))
    with pytest.raises(ConfigError, match="has no goals"):
        change_goal(plain, plain.reset(seed=1)[0], np.zeros(2))


class Follower(Slider):
    """A mass that is pushed by where it was a substep ago; its renderer brings that up to date."""

    def apply_action(self, action):
        super().apply_action(action + 10 * self.data.xpos[-1, 0])

    def render(self):
        mujoco.mj_forward(self.model, self.data)
        return np.zeros((8, 8, 3), np.uint8)


def test_an_episode_that_is_watched_is_the_one_that_is_not():
    courses = []
    for watched in (False, True):
        env = RunEnv(Follower())
        env.capture_frames(watched)
        env.reset(seed=2)
        courses.append([env.step(np.full(1, 0.5))[0]["observation"] for _ in range(20)])
    np.testing.assert_array_equal(*courses)
