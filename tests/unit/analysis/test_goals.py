"""The goal microscope finds walls, and goals that are never asked for or never drawn again."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.analysis.goal_report import cell_rows, episode_rows
from scilab_rl.analysis.goals import NEVER_ASKED, NOT_REACHED, GoalSettings, study_goals
from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.errors import ConfigError

WALL, THRESHOLD = 0.5, 0.15
N_ENVS = 8


class Plane(GoalEnv):
    """Walk in a square to a goal within [-1, 1]; a wall is at x = 0.5."""

    action_size = 2
    threshold = THRESHOLD

    def reset_state(self):
        self.place = np.zeros(2)

    def sample_goal(self):
        return self.np_random.uniform(-1, 1, 2)

    def apply_action(self, action):
        self.place = np.clip(self.place + 0.5 * action, -1, [WALL, 1])

    def achieved_goal(self):
        return self.place

    def get_observation(self):
        return self.place


class UpperHalf(Plane):
    """The same without wall and without goals in one quarter."""

    def apply_action(self, action):
        self.place = np.clip(self.place + 0.5 * action, -1, 1)

    def sample_goal(self):
        while True:
            goal = super().sample_goal()
            if goal.min() < 0:
                return goal


class Stubborn(Plane):
    """The same with a goal that is drawn once."""

    def sample_goal(self):
        return np.array([0.3, -0.4])


class Walker:
    """Goes straight to the goal; its value knows of the wall."""

    gamma = 0.9

    def __init__(self, env):
        self.env = env
        self.observation_space, self.action_space = env.observation_space, env.action_space

    def get_env(self):
        return self.env

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        way = observation["desired_goal"] - observation["achieved_goal"]
        return np.clip(2 * way, -1, 1).astype(np.float32), state

    def value(self, observation):
        return -(observation["desired_goal"][:, 0] > WALL + THRESHOLD).astype(np.float32)


class Wanderer(Walker):
    """Goes anywhere, and sometimes far."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        rng = np.random.default_rng(int(1e6 * abs(observation["achieved_goal"]).sum()))
        return rng.uniform(-1, 1, (len(observation["achieved_goal"]), 2)), state


def vector(task):
    def make():
        return RunEnv(gym.wrappers.TimeLimit(task(), 6))

    return ObservedVecEnv(DummyVecEnv([make] * N_ENVS), "eval", task.__name__)


def study(task, player=Walker, **settings):
    env = vector(task)
    settings = {"cells": (10, 10), "episodes": 2} | settings
    return study_goals(player(env), env, GoalSettings(**settings), task.__name__)


@pytest.fixture(scope="module")
def walled():
    return study(Plane)


def test_a_region_that_cannot_be_reached_is_found_and_named(walled):
    # Cells are 0.2 wide and goals in their middles: those from 0.7 on cannot be reached.
    failed = walled.grid.centers[:, 0] > WALL + THRESHOLD
    assert (walled.successes == np.where(failed, 0, 2)).all()
    [region] = walled.regions
    assert region.kind == NOT_REACHED and sorted(region.cells) == np.flatnonzero(failed).tolist()
    assert walled.overall.value == 0.8
    assert "goal[0] from 0.6 to 1" in region.finding.replace("0.599", "0.6").replace("0.998", "1")
    assert "20 of 100 cells" in region.finding and "maybe it cannot be" in region.finding
    rows = list(cell_rows(walled))
    assert [row["finding"] for row in rows] == np.where(failed, "not reached", "").tolist()
    assert rows[0]["success_rate"] == 1 and 0.3 < rows[0]["low"] < 0.35  # Wilson's of 2 of 2
    assert len(list(episode_rows(walled))) == 200


def test_a_value_that_knows_predicts_success(walled):
    assert walled.calibration.auc.value == 1.0
    assert walled.calibration.brier == 0.0 and walled.calibration.base_brier > 0.1
    assert walled.calibration.skill == 1.0
    assert set(np.unique(walled.calibration.probabilities)) == {0.0, 1.0}


def test_the_worst_goals_are_no_neighbors(walled):
    worst = walled.worst(4)
    cells = walled.played.cells[worst]
    assert len(worst) == 4 and not walled.played.successes[worst].any()
    for cell in cells:
        assert not set(walled.grid.neighbors(int(cell))) & set(cells.tolist())


def test_goals_that_are_never_asked_for_are_found_and_named():
    found = study(UpperHalf)
    [region] = found.regions
    quarter = (found.grid.centers > 0).all(axis=1)
    assert region.kind == NEVER_ASKED and sorted(region.cells) == np.flatnonzero(quarter).tolist()
    assert "Never asked for: goal[0] from" in region.finding
    assert "None of 1,000 resets drew a goal there; 250 would" in region.finding
    assert "the success rate is 1.00" in region.finding
    assert found.overall.value == 1.0 and found.calibration is None


def test_a_goal_that_is_never_resampled_is_found_and_named():
    found = study(Stubborn, Wanderer)
    assert not found.drawn.is_resampled
    assert "Never resampled: a reset of Stubborn keeps the goal" in found.findings[0]
    assert "the cells cover the goals that are achieved" in found.findings[0]
    assert found.asked.sum() == len(found.drawn.goals) == found.asked.max()
    assert NEVER_ASKED in [region.kind for region in found.regions]


def test_goals_of_the_replay_buffer_are_those_of_the_task(walled):
    replayed = walled.replayed
    assert replayed.share == 0.8 and "with hindsight that it did not have" in replayed.origin
    assert abs(replayed.desired).max() <= 1 and replayed.desired[:, 0].max() > 0.9
    # Relabeled goals were achieved, and nobody has been behind the wall.
    assert replayed.achieved[:, 0].max() == pytest.approx(WALL, abs=1e-6)
    assert replayed.relabeled[:, 0].max() == pytest.approx(WALL, abs=1e-6)


def test_the_same_seed_gives_the_same_episodes(walled):
    again = study(Plane)
    assert (again.played.achieved == walled.played.achieved).all()
    assert (again.drawn.goals == walled.drawn.goals).all()


class NoGoals(gym.Env):
    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}


class OwnGoals(Plane):
    """Ignores the option."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)


@pytest.mark.parametrize(
    ("task", "message"), [(NoGoals, "has no goals"), (OwnGoals, "cannot be chosen")]
)
def test_environments_whose_goals_cannot_be_chosen_are_refused(task, message):
    with pytest.raises(ConfigError, match=f"{task.__name__}.*{message}"):
        study(task)


def test_chosen_axes_and_cells_are_checked():
    with pytest.raises(ConfigError, match="--axes must be one to three"):
        study(Plane, axes=(0, 5))
    with pytest.raises(ConfigError, match="--cells needs one number for each of the axes 0, 1"):
        study(Plane, cells=(3, 3, 3))


def test_one_axis_takes_the_other_dimensions_from_drawn_goals():
    found = study(Plane, axes=(0,), cells=(10,))
    assert found.space.others == (1,)
    assert any("Not examined: goal[1]" in note for note in found.notes)
    assert np.ptp(found.played.goals[:, 1]) > 1
