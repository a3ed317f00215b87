from __future__ import annotations

import pickle

import numpy as np
import pytest

from scilab_rl.envs.goal import GoalEnv
from scilab_rl.errors import ConfigError


class Line(GoalEnv):
    """A point on a line that moves by a tenth of the action."""

    action_size = 1
    threshold = 0.25

    def __init__(self, start: float = 0.0, **kwargs) -> None:
        self.start = start
        super().__init__(**kwargs)

    def reset_state(self) -> None:
        self.place = np.array([self.start])

    def sample_goal(self) -> np.ndarray:
        return self.np_random.uniform(-1, 1, 1)

    def apply_action(self, action: np.ndarray) -> None:
        self.place += 0.1 * action

    def achieved_goal(self) -> np.ndarray:
        return self.place

    def get_observation(self) -> np.ndarray:
        return self.place


def test_step_reports_reward_and_success_at_the_threshold() -> None:
    env = Line()
    env.reset(seed=0, options={"desired_goal": [0.375]})
    _, reward, terminated, truncated, info = env.step(np.array([1.0]))  # 0.1, distance 0.275
    assert (reward, terminated, truncated, info) == (-1.0, False, False, {"is_success": False})
    _, reward, _, _, info = env.step(np.array([7.0]))  # clipped to 1: 0.2, distance 0.175
    assert (reward, info) == (0.0, {"is_success": True})
    assert str(reward) == "0.0"  # not -0.0


def test_reaching_the_goal_ends_the_episode_only_if_wanted() -> None:
    env = Line(terminate_on_success=True)
    env.reset(options={"desired_goal": [0.1]})
    assert env.step(np.array([1.0]))[2] is True


def test_compute_functions_take_batches() -> None:
    env = Line(reward_type="dense", terminate_on_success=True)
    achieved, desired = np.array([[0.0], [1.0]]), np.array([[0.25], [0.5]])
    assert env.compute_reward(achieved, desired, {}).tolist() == [-0.25, -0.5]
    assert env.compute_terminated(achieved, desired, {}).tolist() == [True, False]
    assert env.compute_truncated(achieved, desired, {}).tolist() == [False, False]


def test_kept_observations_do_not_move() -> None:
    env = Line()
    first, _ = env.reset(seed=3)
    kept = {key: value.copy() for key, value in first.items()}
    env.step(np.array([1.0]))
    first["desired_goal"] += 1.0  # as somebody may do with his own copy
    assert np.array_equal(env.goal, kept["desired_goal"])
    assert np.array_equal(first["achieved_goal"], kept["achieved_goal"])


def test_goal_is_drawn_anew_and_follows_the_seed() -> None:
    env = Line()
    goals = [env.reset(seed=5)[0]["desired_goal"].item(), env.reset()[0]["desired_goal"].item()]
    again = [env.reset(seed=5)[0]["desired_goal"].item(), env.reset()[0]["desired_goal"].item()]
    assert goals == again
    assert goals[0] != goals[1]


def test_pickling_keeps_the_arguments() -> None:
    env = pickle.loads(pickle.dumps(Line(0.5, threshold=0.125, reward_type="dense")))
    assert (env.start, env.threshold, env.reward_type) == (0.5, 0.125, "dense")


def test_wrong_arguments_say_what_is_allowed() -> None:
    with pytest.raises(ConfigError, match=r"reward_type must be one of sparse, dense.*'dens'"):
        Line(reward_type="dens")
    with pytest.raises(ConfigError, match=r"has shape \(1,\).*has \(2,\)"):
        Line().reset(options={"desired_goal": [0.0, 0.0]})
