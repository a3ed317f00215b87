"""The equations of the cognitive models against values computed by hand."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from scilab_rl.algorithms.models.hybrid import HYBRID
from scilab_rl.algorithms.models.kalmanthompson import KALMANTHOMPSON, log_largest
from scilab_rl.algorithms.models.kalmanucb import KALMANUCB
from scilab_rl.algorithms.models.randomchoice import RANDOMCHOICE
from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.algorithms.models.rescorlawagner2 import RESCORLAWAGNER2
from scilab_rl.algorithms.models.rescorlawagnersticky import RESCORLAWAGNERSTICKY
from scilab_rl.algorithms.models.winstayloseshift import WINSTAYLOSESHIFT
from scilab_rl.learning.cognitive import Seen, Trial, log_likelihoods


def after(model, parameters, *trials, sizes=(1, 2)):
    """Return what a model knows after trials of (state, response, feedback, next state)."""
    memory = model.initial(parameters, *sizes)
    for trial in trials:
        memory = model.update(parameters, memory, Trial(*map(jnp.asarray, trial)))
    return memory


def probabilities(preferences):
    weights = np.exp(np.asarray(preferences, float))
    return weights / weights.sum()


def test_rescorla_wagner_learns_a_share_of_the_error():
    parameters = {"learning_rate": 0.5, "inverse_temperature": 2.0}
    memory = after(RESCORLAWAGNER, parameters, (0, 1, 1.0, 0), (0, 1, 0.0, 0))
    assert np.allclose(memory, [[0.5, 0.375]])  # 0.5 -> 0.75 -> 0.375
    assert np.allclose(RESCORLAWAGNER.choose(parameters, memory, 0), [1.0, 0.75])


def test_gains_and_losses_have_rates_of_their_own():
    parameters = {
        "learning_rate_gain": 0.5, "learning_rate_loss": 0.1, "inverse_temperature": 1.0,
    }  # fmt: skip
    memory = after(RESCORLAWAGNER2, parameters, (0, 0, 1.0, 0), (0, 0, 0.0, 0))
    assert np.allclose(memory, [[0.675, 0.5]])  # 0.5 -> 0.75 -> 0.675


def test_stickiness_is_a_bonus_for_the_last_response():
    parameters = {"learning_rate": 0.5, "inverse_temperature": 2.0, "stickiness": 0.3}
    memory = after(RESCORLAWAGNERSTICKY, parameters, (0, 0, 1.0, 0), (0, 1, 0.5, 0))
    assert np.allclose(RESCORLAWAGNERSTICKY.choose(parameters, memory, 0), [1.5, 1.3])


def test_a_winner_stays_and_a_loser_shifts():
    parameters = {"p_stay_win": 0.9, "p_shift_loss": 0.6}
    won = after(WINSTAYLOSESHIFT, parameters, (0, 2, 1.0, 0), sizes=(1, 3))
    lost = after(WINSTAYLOSESHIFT, parameters, (0, 2, 0.0, 0), sizes=(1, 3))
    assert np.allclose(won, [[0.05, 0.05, 0.9]])
    assert np.allclose(lost, [[0.3, 0.3, 0.4]])
    assert np.allclose(np.exp(WINSTAYLOSESHIFT.choose(parameters, lost, 0)), lost[0])


def test_a_bias_is_the_log_odds_of_the_first_response():
    parameters = {"bias": math.log(3.0)}
    memory = after(RANDOMCHOICE, parameters, (0, 1, 1.0, 0))
    assert np.allclose(probabilities(RANDOMCHOICE.choose(parameters, memory, 0)), [0.75, 0.25])


@pytest.mark.parametrize("model", [KALMANUCB, KALMANTHOMPSON])
def test_the_kalman_gain_is_the_share_of_the_variance_that_is_uncertainty(model):
    parameters = {
        "observation_sd": 0.3, "drift_sd": 0.1, "inverse_temperature": 2.0,
        "uncertainty_bonus": 1.0,
    }  # fmt: skip
    memory = after(model, parameters, (0, 0, 1.0, 0))
    assert np.allclose(memory["mean"], [[0.75, 0.5]])  # gain 0.09 / (0.09 + 0.09)
    assert np.allclose(memory["var"], [[0.055, 0.1]])  # 0.045 + 0.01, 0.09 + 0.01


def test_uncertainty_is_worth_its_bonus():
    parameters = {"inverse_temperature": 2.0, "uncertainty_bonus": 0.5}
    memory = {"mean": np.array([[0.5, 0.4]]), "var": np.array([[0.04, 0.16]])}
    assert np.allclose(KALMANUCB.choose(parameters, memory, 0), [1.2, 1.2])


def test_thompson_chooses_as_often_as_an_arm_is_the_best():
    two = np.exp(log_largest(np.array([0.6, 0.4]), np.array([0.01, 0.03])))
    assert np.isclose(two[0], 0.5 * math.erfc(-1.0 / math.sqrt(2)), atol=1e-4)  # Phi(0.2 / 0.2)
    mean, var = np.array([0.5, 0.6, 0.3]), np.array([0.04, 0.02, 0.09])
    draws = np.random.default_rng(0).normal(mean, np.sqrt(var), (100_000, 3))
    simulated = np.bincount(draws.argmax(axis=1)) / len(draws)
    assert np.allclose(np.exp(log_largest(mean, var)), simulated, atol=0.006)


def test_habit_and_planning_learn_what_the_paper_says():
    parameters = {
        "learning_rate_1": 0.5, "learning_rate_2": 0.4, "eligibility": 0.6,
        "model_based_weight": 0.25, "stickiness": 0.1,
        "inverse_temperature_1": 2.0, "inverse_temperature_2": 3.0,
    }  # fmt: skip
    # Response 1 leads to planet 1 (rare); alien 0 pays.
    memory = after(HYBRID, parameters, (0, 1, 0.0, 1), (1, 0, 1.0, 0), sizes=(3, 2))
    assert np.allclose(memory["second"], [[0.4, 0.0], [0.0, 0.0]])
    assert np.allclose(memory["first"], [0.0, 0.3])  # 0.5 (0 - 0) + 0.5 * 0.6 (1 - 0)
    # Planning: 0.7 * 0.4 = 0.28 for response 0, 0.3 * 0.4 = 0.12 for response 1.
    first = [2 * 0.25 * 0.28, 2 * (0.25 * 0.12 + 0.75 * 0.3 + 0.1)]
    assert np.allclose(HYBRID.choose(parameters, memory, jnp.asarray(0)), first)
    assert np.allclose(HYBRID.choose(parameters, memory, jnp.asarray(1)), [1.2, 0.0])
    assert np.allclose(HYBRID.choose(parameters, memory, jnp.asarray(2)), [0.0, 0.0])


def test_a_block_begins_without_memory():
    parameters = {"learning_rate": 0.5, "inverse_temperature": 2.0}
    seen = Seen(
        np.zeros(3, int), np.array([0, 0, 0]), np.array([0.0, 1.0, 1.0]), np.array([1, 0, 1], bool)
    )
    found = log_likelihoods(RESCORLAWAGNER, 1, 2, parameters, seen, np.array([0, 0, 0]))
    # Then values of 0.5 and 0.5, 0.75 and 0.5, and again 0.5 and 0.5.
    assert np.allclose(np.exp(found), [0.5, 1 / (1 + math.exp(-0.5)), 0.5], atol=1e-6)
