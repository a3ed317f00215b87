"""Trial tables say what the agent saw, did, got and thought, step by step."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import sb3_contrib
import torch

from scilab_rl.algorithms.cleandqn import CLEANDQN
from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_eval_env, observed_layer
from scilab_rl.errors import ConfigError
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.training.trajectory_table import by_episode, collect, softmax_choice


@pytest.fixture
def walker():
    env = make_eval_env(RunConfig("scilab_rl.testing:TinyDiscrete-v0", seed=3))
    yield CLEANDQN(env=env, seed=1, buffer_size=100, net_arch=[8]), env
    env.close()


def test_rows_hold_the_very_step(walker) -> None:
    model, env = walker
    rows = collect(model, env, 3, seed=5)
    assert [row["episode"] for row in rows if row["step"] == 0] == [0, 1, 2]
    inspector = AgentInspector(model)
    for row, after in itertools.pairwise(rows):
        observation = np.array([row["observation_0"], row["observation_1"]], np.float32)
        values = [inspector.q_values(observation, np.int64(a)).mean() for a in (0, 1)]
        assert [row["q_0"], row["q_1"]] == pytest.approx(values, abs=1e-6)
        assert row["action"] == int(np.argmax(values))
        assert row["q_value"] == pytest.approx(max(values), abs=1e-6)
        if after["episode"] == row["episode"]:  # right is +0.2, left is -0.2
            moved = after["observation_0"] - row["observation_0"]
            assert moved == pytest.approx(0.2 if row["action"] == 1 else -0.2, abs=1e-5)
            assert not row["terminated"] and not row["truncated"]
        else:
            assert row["terminated"] or row["truncated"]


def test_one_critic_alone_is_never_uncertain(walker) -> None:
    """An empty column, not zeros: nobody was there to disagree."""
    model, env = walker
    rows = collect(model, env, 1, seed=5)
    assert not any("critic_variance" in row for row in rows)


def test_the_td_error_has_its_sign_and_its_mean_has_none(walker) -> None:
    model, env = walker
    rows = collect(model, env, 1, seed=5)
    first, second = rows[0], rows[1]
    expected = first["reward"] + model.gamma * second["value"] - first["q_value"]
    assert first["td_error"] == pytest.approx(expected, abs=1e-5)
    (episode,) = by_episode(rows)
    mean = np.mean([abs(row["td_error"]) for row in rows])
    assert episode["mean_abs_td_error"] == pytest.approx(mean)


def test_episodes_summarise_steps(walker) -> None:
    model, env = walker
    rows = collect(model, env, 2, seed=5)
    episodes = by_episode(rows)
    assert [e["steps"] for e in episodes] == [
        sum(row["episode"] == number for row in rows) for number in (0, 1)
    ]
    assert episodes[0]["return"] == sum(row["reward"] for row in rows if row["episode"] == 0)
    values = [row["value"] for row in rows if row["episode"] == 1]
    assert episodes[1]["mean_value"] == pytest.approx(np.mean(values))


def test_a_participant_chooses_by_softmax(walker) -> None:
    model, _ = walker
    observation, inspector = np.array([0.1, 1.0], np.float32), AgentInspector(model)
    gap = float(
        (
            inspector.q_values(observation, np.int64(1))
            - inspector.q_values(observation, np.int64(0))
        ).mean()
    )
    choose = softmax_choice(model, 4.0, seed=2)
    share = np.mean([choose(observation) for _ in range(2000)])
    assert share == pytest.approx(1 / (1 + np.exp(-4.0 * gap)), abs=0.04)


def test_goals_and_continuous_actions_have_columns() -> None:
    env = make_eval_env(RunConfig("scilab_rl.testing:TinyReach-v0", seed=3))
    model = CLEANSAC(env=env, seed=1, buffer_size=100, net_arch=[8])
    row = collect(model, env, 1, seed=5)[0]
    assert {
        "achieved_goal_0",
        "desired_goal_0",
        "action_0",
        "goal_distance",
        "critic_variance",
    } <= {*row}
    goals = [[row[f"{kind}_goal_{i}"] for i in (0, 1)] for kind in ("achieved", "desired")]
    assert row["goal_distance"] == pytest.approx(np.linalg.norm(np.subtract(*goals)), abs=1e-5)
    with pytest.raises(ConfigError, match="--softmax needs an algorithm with values of discrete"):
        softmax_choice(model, 1.0, seed=1)
    env.close()


def test_tables_speak_of_the_environments_own_values() -> None:
    """Actions from -1 to 1, hours from 2, dice from 1: what the algorithm counts from 0."""
    env = make_eval_env(RunConfig("tests.faults.archetypes:OddPartsChoice-v0", seed=3))
    model = CLEANDQN(env=env, seed=1, buffer_size=100, net_arch=[8])
    rows = collect(model, env, 2, seed=5)
    for row in rows:
        values = [row[f"q_{action}"] for action in (-1, 0, 1)]
        assert row["action"] == np.argmax(values) - 1
        assert row["q_value"] == pytest.approx(max(values), abs=1e-6)
        assert 2 <= row["hour_0"] <= 20
        assert {row["dice_0"], row["dice_1"]} <= set(range(1, 7))
        assert isinstance(row["light_0"], float)
    choose = softmax_choice(model, 0.0, seed=2)
    observation = observed_layer(env).state()["observations"]
    single = {key: value[0] for key, value in observation.items()}
    assert {int(choose(single)) for _ in range(30)} == {-1, 0, 1}
    chosen = collect(model, env, 2, seed=5, choose=choose)
    assert {row["action"] for row in chosen} == {-1, 0, 1}
    env.close()


def test_a_recurrent_policy_acts_with_its_memory() -> None:
    """Each action is the one that the LSTM computes from the whole episode so far."""
    env = make_eval_env(RunConfig("CueMemory-v0", seed=3))
    model = sb3_contrib.RecurrentPPO("MlpLstmPolicy", env, seed=2, device="cpu")
    with torch.no_grad():  # large weights, so that memory changes the likeliest action
        for weights in model.policy.parameters():
            weights *= 5
    rows, state, forgetful = collect(model, env, 6, seed=5), None, []
    for row in rows:
        seen = np.array([[row[f"observation_{i}"] for i in range(6)]], np.float32)
        starts = np.array([row["step"] == 0])
        action, state = model.predict(seen, state, starts, deterministic=True)
        assert row["action"] == action[0]
        forgetful.append(model.predict(seen, deterministic=True)[0][0])
    assert [row["action"] for row in rows] != forgetful
    env.close()
