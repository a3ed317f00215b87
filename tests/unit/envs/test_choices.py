"""The choice tasks, against their papers and against numbers computed by hand."""

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.choices.bandit import Bandit, ProbabilisticReversal
from scilab_rl.envs.choices.base import COLUMNS_KEY, random_walk
from scilab_rl.envs.choices.hidden_goal import HiddenGoal
from scilab_rl.envs.choices.horizon import Horizon
from scilab_rl.envs.choices.trial_space import TrialSpace
from scilab_rl.envs.choices.two_step import TwoStep
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError

TASKS = (Bandit, ProbabilisticReversal, TwoStep, Horizon, HiddenGoal)


def play(task, choose, seed=0):
    """Play a block and return the columns of its choices."""
    task.reset(seed=seed)
    rows, over = [], False
    while not over:
        observation, reward, over, _, info = task.step(choose(task))
        assert task.observation_space.contains(observation)
        assert reward == info[COLUMNS_KEY]["feedback"]
        rows.append(info[COLUMNS_KEY])
    return rows


def test_an_observation_is_decoded_as_it_was_encoded():
    space = TrialSpace(3, 2)
    assert space.encode(2, 1, 0.5).tolist() == [0, 0, 1, 0, 1, 0.5]
    batch = np.stack([space.encode(2, 1, 0.5), space.encode(0, None, 0.9)])
    states, responses, feedback = space.decode(batch)
    assert (states.tolist(), responses.tolist(), feedback.tolist()) == ([2, 0], [1, -1], [0.5, 0])


@pytest.mark.parametrize("cls", TASKS)
def test_a_block_ends_after_its_trials_and_is_drawn(cls):
    task = cls(render_mode="rgb_array")
    rows = play(task, lambda task: 0)
    assert rows[-1]["trial"] <= task.n_trials - 1
    assert [row["trial"] for row in rows] == sorted(row["trial"] for row in rows)
    frame = task.render()
    assert frame.shape == (360, 480, 3)
    task.reset()
    assert not np.array_equal(frame, task.render())


def test_the_same_seed_pays_the_same_for_the_same_choices():
    task = Bandit(schedule="drifting", n_arms=4)
    always, mixed = (
        play(task, choose, seed=3) for choose in (lambda task: 1, lambda task: task.trial % 2)
    )
    assert [row["feedback"] for row in always[1::2]] == [row["feedback"] for row in mixed[1::2]]


def test_a_reversal_turns_the_probabilities_round():
    rows = play(Bandit(schedule="reversal", reversal_every=40), lambda task: 0)
    first = [row["mean_0"] for row in rows]
    assert {rows[0]["mean_0"], rows[40]["mean_0"]} == {0.2, 0.8}
    assert len(set(first[:40])) == 1 and first[40] != first[39] and first[80] == first[0]


def test_static_arms_pay_as_often_as_they_promise():
    task = Bandit(n_trials=20_000, n_arms=3)
    task.reset(seed=1)
    assert sorted(task.means[0]) == [0.2, 0.5, 0.8]
    assert np.abs(task.outcomes.mean(axis=0) - task.means[0]).max() < 0.02


def test_points_are_gaussian_around_the_mean():
    task = Bandit(n_trials=20_000, feedback="points")
    task.reset(seed=1)
    assert np.allclose(task.outcomes.std(axis=0), 0.04, atol=0.001)
    assert 0 <= task.outcomes.min() and task.outcomes.max() <= 1


def test_walks_stay_between_their_bounds_and_move_as_far_as_they_should():
    walks = random_walk(np.random.default_rng(0), (5000, 4), sd=0.025, low=0.25, high=0.75)
    assert 0.25 <= walks.min() < 0.27 and 0.73 < walks.max() <= 0.75
    assert np.isclose(np.diff(walks, axis=0).std(), 0.025, rtol=0.05)


def test_a_reversal_waits_for_the_criterion():
    task = ProbabilisticReversal(p_reversal=1.0, criterion=4)
    rows = play(task, lambda task: task.better)
    assert [row["reversals"] for row in rows[:9]] == [0, 0, 0, 0, 1, 1, 1, 1, 2]
    task = ProbabilisticReversal(p_reversal=1.0)
    assert {row["reversals"] for row in play(task, lambda task: 1 - task.better)} == {0}


def test_two_steps_lead_to_the_common_planet_seven_times_of_ten():
    rows = play(TwoStep(n_trials=4000), lambda task: task.trial % 2)
    first, second = rows[::2], rows[1::2]
    assert {row["state"] for row in first} == {0} and {row["state"] for row in second} == {1, 2}
    assert {row["feedback"] for row in first} == {0.0}
    same_side = np.mean(
        [a["response"] + 1 == b["state"] for a, b in zip(first, second, strict=True)]
    )
    assert same_side == np.mean([row["common"] for row in first])
    assert abs(same_side - 0.7) < 0.025


def test_the_first_choice_is_correct_where_its_planets_are_worth_more():
    task = TwoStep()
    task.reset(seed=0)
    task.means[0] = [[0.3, 0.6], [0.5, 0.4]]  # 0.7 * 0.6 + 0.3 * 0.5 = 0.57, 0.7 * 0.5 + 0.18
    assert task.step(0)[-1][COLUMNS_KEY]["correct"] == 1
    task.reset(seed=0)
    task.means[0] = [[0.3, 0.6], [0.5, 0.4]]
    assert task.step(1)[-1][COLUMNS_KEY]["correct"] == 0


def test_horizon_games_sample_four_times_and_then_leave_the_choice():
    games = [play(Horizon(), lambda task: 1, seed) for seed in range(200)]
    assert {len(game) for game in games} == {5, 10}
    for game in games:
        forced, free = game[:4], game[4:]
        assert [row["forced"] for row in game] == [1] * 4 + [0] * len(free)
        assert {row["response"] for row in free} == {1}
        samples = sum(row["response"] for row in forced)
        assert forced[0]["information"] == 2 * samples - 4
        assert [row["state"] for row in free] == [*range(free[0]["horizon"])][::-1]
    differences = {round(abs(game[0]["mean_0"] - game[0]["mean_1"]), 2) for game in games}
    assert differences == {0.04, 0.08, 0.12, 0.2, 0.3}


def test_the_goal_is_hidden_until_it_is_found():
    task = HiddenGoal(size=3)
    task.reset(seed=0)
    task.state, task.goal = 0, 4
    observation, reward, over, _, info = task.step(1)
    assert (task.state, reward, over, info["is_success"]) == (1, 0.0, False, False)
    _, reward, over, _, info = task.step(2)
    assert (task.state, reward, over, info["is_success"]) == (4, 1.0, True, True)
    assert observation[:9].argmax() == 1


def test_walls_hold_and_visits_are_counted():
    task = HiddenGoal(size=2)
    task.reset(seed=0)
    task.state, task.goal, task.visits = 0, 3, [1, 0, 0, 0]
    rows = [task.step(0)[-1][COLUMNS_KEY] for _ in range(2)] + [task.step(1)[-1][COLUMNS_KEY]]
    entered = [(task.visits[0], task.visits[1])]
    assert [(row["visits"], row["correct"]) for row in rows] == [(1, 0), (2, 0), (0, 1)]
    assert entered == [(3, 1)]


@pytest.mark.parametrize(
    ("cls", "arguments", "message"),
    [
        (Bandit, {"schedule": "drifted"}, "Did you mean 'drifting'"),
        (Bandit, {"n_arms": 1}, "from 2 to 10, but it is 1"),
        (Bandit, {"p_best": 0.1}, "p_worst <= p_best"),
        (TwoStep, {"n_trials": 0}, "at least 1, but it is 0"),
        (Horizon, {"horizon": 3}, "1, 6 or null, but it is 3"),
        (HiddenGoal, {"size": 1}, "from 2 to 20, but it is 1"),
    ],
)
def test_impossible_tasks_are_refused(cls, arguments, message):
    with pytest.raises(ConfigError, match=message):
        cls(**arguments)


def test_a_long_id_names_a_bandit():
    env_id, notice = resolve_env_id("Bandit-drifting-a4")
    assert notice == "Bandit-drifting-a4-v0 is Bandit-v0 with schedule=drifting, n_arms=4."
    task = gym.make(env_id).unwrapped
    assert (task.schedule, task.action_space.n) == ("drifting", 4)
