"""The losses of contrastive RL by hand, and what the probes say about goals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer

jax = pytest.importorskip("jax")

import jax.numpy as jnp  # noqa: E402

from scilab_rl.algorithms import jaxcrl  # noqa: E402
from scilab_rl.algorithms.jaxcrl import JAXCRL, Settings  # noqa: E402
from scilab_rl.errors import ConfigError  # noqa: E402
from scilab_rl.learning.inspector import AgentInspector  # noqa: E402
from scilab_rl.learning.jax_engine import Batch  # noqa: E402

KEY = jax.random.key(0)
# Observations are (achieved, desired, speed): the goal is number 1.
GOAL = (1, 2)


def settings(**changed: Any) -> Settings:
    usual = {
        "learning_rate": 0.1, "gamma": 0.5, "tau": 0.0, "n_target_critics": 1, "policy_delay": 1,
        "precision": "float32", "goal": GOAL, "energy": "dot", "loss": "symmetric",
        "logsumexp_penalty": 0.0, "random_goals": 0.0, "learns_ent_coef": False,
        "target_entropy": -0.5,
    }  # fmt: skip
    return Settings(**(usual | changed))


def layer(rows: list[list[float]]) -> Any:
    return [{"weight": jnp.array(rows), "bias": jnp.zeros(len(rows[0]))}]


def state() -> Any:
    """phi = (achieved, action), psi = (2 g, g); the policy is wide, and its mean is tanh(0)."""
    networks = {
        "state_action_encoder": layer([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]),
        "goal_encoder": layer([[2.0, 1.0]]),
        "actor": layer([[0.0, 0.0]] * 3),
    }
    return jax.tree.map(jnp.array, jaxcrl.initial_state(networks, 0.5, 0.1))


def batch() -> Batch:
    rows = np.array([[1.0, 3.0, 7.0], [2.0, -1.0, 7.0]], np.float32)
    nothing = np.zeros(2, np.float32)
    actions = np.array([[0.5], [-0.5]], np.float32)
    return Batch(rows, actions, nothing, rows, nothing, nothing)


def encoders() -> Any:
    return {name: state()[name] for name in ("state_action_encoder", "goal_encoder")}


def test_infonce_is_the_cross_entropy_of_each_steps_own_goal() -> None:
    logits = jnp.array([[1.0, 0.0], [2.0, 4.0]])
    rows = [math.log(math.exp(1) + 1), math.log(math.exp(2) + math.exp(4))]
    columns = [math.log(math.exp(1) + math.exp(2)), math.log(1 + math.exp(4))]
    forward = (rows[0] - 1 + rows[1] - 4) / 2
    backward = (columns[0] - 1 + columns[1] - 4) / 2
    penalty = (rows[0] ** 2 + rows[1] ** 2) / 2
    for kind, weight, expected in (
        ("infonce", 0.0, forward),
        ("symmetric", 0.0, forward + backward),
        ("infonce", 0.1, forward + 0.1 * penalty),
    ):
        loss = jaxcrl.contrastive_loss(logits, kind, weight)
        assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_critic_compares_each_step_with_each_goal() -> None:
    """The steps are (1, 0.5) and (2, -0.5), and the goals (6, 3) and (-2, -1)."""
    loss, said = jaxcrl.critic_loss(encoders(), settings(), batch())
    logits = np.array([[7.5, -2.5], [10.5, -3.5]])
    assert float(loss) == pytest.approx(
        float(jaxcrl.contrastive_loss(jnp.array(logits), "symmetric", 0.0)), rel=1e-5
    )
    assert float(said["q_mean"]) == pytest.approx(2.0)
    assert float(said["accuracy"]) == 0.5  # the second step is told the first one's goal


def test_l2_is_minus_the_distance_in_both_forms() -> None:
    phi, psi = np.array([[1.0, 0.5], [2.0, -0.5]]), np.array([[6.0, 3.0], [-2.0, -1.0]])
    distances = [[math.hypot(5, 2.5), math.hypot(3, 1.5)], [math.hypot(4, 3.5), math.hypot(4, 0.5)]]
    matrix = jaxcrl.all_similarities("l2", jnp.array(phi), jnp.array(psi))
    np.testing.assert_allclose(matrix, -np.array(distances), rtol=1e-5)
    np.testing.assert_allclose(
        jaxcrl.similarities("l2", phi, psi), [-distances[0][0], -distances[1][1]], rtol=1e-5
    )


def test_actor_is_paid_in_similarity_and_entropy() -> None:
    """With phi = (x, a): f = 2 g x + g a, for the own goals 3 and -1 or for each other's."""
    for share, goals in ((0.0, [3.0, -1.0]), (1.0, [-1.0, 3.0])):
        chosen = settings(random_goals=share)
        loss, log_prob = jaxcrl.actor_loss(state()["actor"], chosen, state(), batch(), KEY)
        actions, same = jaxcrl.sample(
            state()["actor"], batch().observations, KEY, 1.0, "float32"
        )  # the policy ignores what it sees
        np.testing.assert_array_equal(log_prob, same)
        f = [2 * g * x + g * float(a) for g, x, a in zip(goals, (1, 2), actions[:, 0], strict=True)]
        expected = np.mean([0.5 * float(p) - s for p, s in zip(log_prob, f, strict=True)])
        assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_an_update_moves_all_networks_and_a_learned_temperature() -> None:
    before = state()
    for learns in (False, True):
        after, losses = jaxcrl.update(
            settings(learns_ent_coef=learns), before, batch(), KEY, jnp.uint32(0)
        )
        for name in ("actor", "state_action_encoder", "goal_encoder"):
            assert (after[name][0]["weight"] != before[name][0]["weight"]).any()
        assert bool(after["log_ent_coef"] != before["log_ent_coef"]) == learns
        assert ("ent_coef_loss" in losses) == learns
        assert float(losses["ent_coef"]) == pytest.approx(0.5)


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(**kwargs: Any) -> JAXCRL:
        small = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16, "net_arch": [8]}
        return JAXCRL(env=make_env("TinyReach-v0"), device="cpu", seed=1, **(small | kwargs))

    return make_model


def test_similarity_and_steps_to_goal_are_answered(make: Any) -> None:
    """Steps are the difference of two similarities in units of -log gamma, and 0 at the goal."""
    model = make(gamma=0.5)
    inspector = AgentInspector(model)
    assert {"similarity", "steps_to_goal", "log_prob"} <= inspector.quantities
    assert "value" not in inspector.quantities  # a similarity is not a return
    place, action = np.array([0.5, 0.0], np.float32), np.zeros(2, np.float32)
    near = {"observation": place, "achieved_goal": place, "desired_goal": place}
    far = near | {"desired_goal": np.array([-0.5, 0.9], np.float32)}
    lost = inspector.similarity(near, action) - inspector.similarity(far, action)
    assert inspector.steps_to_goal(near, action) == 0.0
    expected = max(lost / math.log(2), 0.0)
    assert inspector.steps_to_goal(far, action) == pytest.approx(expected, abs=1e-5)


def test_choices_and_buffers_that_cannot_be_are_refused(make: Any) -> None:
    with pytest.raises(ConfigError, match=r"energy must be l2 or dot.*Did you mean 'dot'"):
        make(energy="dott")
    with pytest.raises(ConfigError, match="loss must be symmetric or infonce"):
        make(loss="nce")
    with pytest.raises(ConfigError, match="needs our own hindsight replay"):
        make(replay_buffer_class=ReplayBuffer)


@pytest.mark.slow
def test_learns_to_reach_without_reading_a_reward(make: Any) -> None:
    from scilab_rl.training.evaluation import evaluate

    model = make(learning_rate=1e-3, net_arch=[64, 64], batch_size=128, gamma=0.9, buffer_size=5000)
    model.learn(4000)
    assert evaluate(model, model.get_env(), 20, seed=5).metrics()["eval/success_rate"] >= 0.8
