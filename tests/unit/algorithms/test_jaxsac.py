"""The equations are those of `cleansac`, whose tests have them by hand: both must agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

jax = pytest.importorskip("jax")

import jax.numpy as jnp  # noqa: E402

from scilab_rl.algorithms import cleansac, jaxsac  # noqa: E402
from scilab_rl.algorithms.jaxsac import JAXSAC, Settings  # noqa: E402
from scilab_rl.errors import ConfigError  # noqa: E402
from scilab_rl.learning.jax_engine import Batch, dense_layers  # noqa: E402
from scilab_rl.learning.replay import HindsightReplayBuffer  # noqa: E402
from scilab_rl.metrics.logger import MetricLogger  # noqa: E402
from scilab_rl.training.policy import load_policy, save_policy  # noqa: E402

N_OBSERVATIONS, N_ACTIONS, BATCH = 5, 2, 8


def settings(**changed: Any) -> Settings:
    usual = {
        "learning_rate": 0.1,
        "gamma": 0.9,
        "tau": 0.25,
        "learns_ent_coef": True,
        "target_entropy": -2.0,
        "n_target_critics": 2,
        "policy_delay": 1,
        "backup_entropy": True,
        "scale": 1.0,
        "precision": "float32",
    }
    return Settings(**(usual | changed))


def a_state(n_critics: int = 2) -> Any:
    np.random.seed(4)
    actor = dense_layers([N_OBSERVATIONS, 6, 2 * N_ACTIONS])
    critic = dense_layers([N_OBSERVATIONS + N_ACTIONS, 6, 1], n=n_critics)
    state = jaxsac.initial_state(actor, critic, 0.3, 0.1)
    return jax.tree.map(jnp.array, state)


def a_batch(low: float = -np.inf, high: float = np.inf) -> Batch:
    rng = np.random.default_rng(5)
    return Batch(
        observations=rng.standard_normal((BATCH, N_OBSERVATIONS)).astype(np.float32),
        actions=rng.uniform(-1, 1, (BATCH, N_ACTIONS)).astype(np.float32),
        rewards=-rng.integers(0, 2, BATCH).astype(np.float32),
        next_observations=rng.standard_normal((BATCH, N_OBSERVATIONS)).astype(np.float32),
        dones=rng.integers(0, 2, BATCH).astype(np.float32),
        return_bounds=np.array([low, high], np.float32),
    )


def column(values: Any) -> torch.Tensor:
    return torch.as_tensor(np.array(values)).reshape(-1, 1)


KEY = jax.random.key(0)


def targets_by_cleansac(state: Any, batch: Batch, ent_coef: float) -> np.ndarray:
    action_key, _ = jax.random.split(KEY)
    actions, log_prob = jaxsac.sample(
        state["actor"], batch.next_observations, action_key, 1.0, "float32"
    )
    next_q = jaxsac.q_values(state["critic_target"], batch.next_observations, actions, "float32")
    return cleansac.soft_target(
        column(batch.rewards),
        column(batch.dones),
        torch.as_tensor(np.array(next_q).T),
        column(log_prob),
        ent_coef,
        0.9,
    ).numpy()[:, 0]


def test_targets_are_those_of_cleansac() -> None:
    state, batch = a_state(), a_batch()
    targets, next_q = jaxsac.soft_targets(settings(), state, batch, KEY)
    np.testing.assert_allclose(targets, targets_by_cleansac(state, batch, 0.3), rtol=1e-5)
    assert next_q.shape == (2, BATCH)


def test_targets_without_entropy_and_within_what_returns_can_be() -> None:
    state = a_state()
    targets, _ = jaxsac.soft_targets(settings(backup_entropy=False), state, a_batch(), KEY)
    np.testing.assert_allclose(targets, targets_by_cleansac(state, a_batch(), 0.0), rtol=1e-5)
    bounded, _ = jaxsac.soft_targets(
        settings(backup_entropy=False), state, a_batch(-0.5, -0.1), KEY
    )
    np.testing.assert_allclose(bounded, np.clip(targets, -0.5, -0.1))
    assert (np.array(bounded) != np.array(targets)).any()


def test_a_random_few_of_a_large_ensemble_give_the_target() -> None:
    state, batch = a_state(n_critics=5), a_batch()
    targets, next_q = jaxsac.soft_targets(
        settings(n_target_critics=2, backup_entropy=False), state, batch, KEY
    )
    values = (np.array(targets) - batch.rewards) / 0.9
    pairs = [(i, j) for i in range(5) for j in range(i)]
    alive = batch.dones == 0
    fits = [
        np.allclose(np.minimum(next_q[i], next_q[j])[alive], values[alive], atol=1e-5)
        for i, j in pairs
    ]
    assert sum(fits) >= 1
    assert not np.allclose(next_q.min(axis=0)[alive], values[alive])


def test_losses_are_those_of_cleansac() -> None:
    state, batch = a_state(), a_batch()
    targets = np.linspace(-1, 1, BATCH).astype(np.float32)
    loss, q = jaxsac.critic_loss(state["critic"], batch, targets, "float32")
    expected = cleansac.critic_loss(torch.as_tensor(np.array(q).T), column(targets))
    assert float(loss) == pytest.approx(expected.item(), rel=1e-5)

    loss, log_prob = jaxsac.actor_loss(state["actor"], settings(), state, batch, KEY)
    actions, same = jaxsac.sample(state["actor"], batch.observations, KEY, 1.0, "float32")
    np.testing.assert_array_equal(log_prob, same)
    q = jaxsac.q_values(state["critic"], batch.observations, actions, "float32")
    expected = cleansac.actor_loss(column(log_prob), torch.as_tensor(np.array(q).T), 0.3)
    assert float(loss) == pytest.approx(expected.item(), rel=1e-5)

    loss = jaxsac.temperature_loss(jnp.log(0.3), log_prob, -2.0)
    expected = cleansac.temperature_loss(torch.tensor(0.3).log(), column(log_prob), -2.0)
    assert float(loss) == pytest.approx(expected.item(), rel=1e-5)


def test_log_density_is_that_of_cleansac() -> None:
    noise = np.array([[1.0, -0.3]], np.float32)
    log_std = np.array([[0.2, -1.0]], np.float32)
    unsquashed = 0.1 + np.exp(log_std) * noise
    expected = cleansac.squashed_log_prob(*map(torch.tensor, (noise, log_std, unsquashed)), 0.7)
    result = jaxsac.squashed_log_prob(noise, log_std, unsquashed, 0.7)
    np.testing.assert_allclose(result, expected[:, 0], rtol=1e-5)


def test_an_update_is_one_step_of_adam_and_a_step_of_the_targets() -> None:
    before, batch = a_state(), a_batch()
    after, losses = jaxsac.update(settings(), before, batch, KEY, jnp.uint32(0))
    weight, old = (s["critic"][0]["weight"] for s in (after, before))
    # The first step of Adam is the learning rate in each direction that matters.
    steps = np.abs(np.array(weight - old))
    assert np.quantile(steps, 0.9) == pytest.approx(0.1, rel=1e-3)
    target = after["critic_target"][0]["weight"]
    np.testing.assert_allclose(target, 0.25 * weight + 0.75 * old, rtol=1e-5)
    assert after["log_ent_coef"] != before["log_ent_coef"]
    assert float(losses["ent_coef"]) == pytest.approx(0.3)


def test_the_actor_waits_for_its_turn() -> None:
    before, batch = a_state(), a_batch()
    for index, is_due in ((0, True), (1, False), (2, False), (3, True)):
        after, losses = jaxsac.update(
            settings(policy_delay=3), before, batch, KEY, jnp.uint32(index)
        )
        moved = (after["actor"][0]["weight"] != before["actor"][0]["weight"]).any()
        assert bool(moved) == is_due
        assert (float(losses["actor_loss"]) != 0.0) == is_due  # else that of the last update


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(n_envs: int = 1, **kwargs: Any) -> JAXSAC:
        small = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16, "net_arch": [8]}
        env = make_env("TinyReach-v0", n_envs)
        kwargs = small | {"replay_buffer_class": HindsightReplayBuffer, "seed": 1} | kwargs
        return JAXSAC(env=env, device="cpu", **kwargs)

    return make_model


def test_as_many_updates_as_steps(make: Any) -> None:
    model = make(n_envs=2).learn(100)
    assert model.num_timesteps == 100
    assert model.rounds.n_started == 60  # the 30 rounds after step 40, of two steps each
    assert model.n_updates == 58  # the last round is still under way
    assert make(gradient_steps=3, overlap=False).learn(50).n_updates == 30


def test_overlap_only_delays_the_acting_policy(make: Any) -> None:
    overlapping = make()
    overlapping.learn(41)  # one round
    waiting = make(overlap=False)
    waiting.learn(41)  # one round, started with the same weights and transitions
    trained = waiting.rounds.networks["actor"][0]["weight"]
    untrained = overlapping.rounds.networks["actor"][0]["weight"]
    assert (trained != untrained).any()
    overlapping.finish_round()
    np.testing.assert_array_equal(trained, overlapping.rounds.networks["actor"][0]["weight"])


def test_restored_policy_waits_for_an_episode_as_well(make: Any) -> None:
    model = make()
    model.rounds.n_started = 100  # as after loading
    model.learn(41)  # ended none when its first steps are taken
    assert model.rounds.n_started == 101


def test_policy_that_is_saved_within_a_step_loads(make: Any, tmp_path: Path) -> None:
    model = make()

    def save(_locals: dict[str, Any], _globals: dict[str, Any]) -> bool:
        save_policy(model, tmp_path / "policy", 1)
        return model.num_timesteps < 50

    model.learn(60, callback=save)
    loaded = make()
    load_policy(loaded, tmp_path / "policy")
    assert loaded.num_timesteps == 50


def test_metrics_and_answers(make: Any) -> None:
    model = make(n_critics=3)
    model.set_logger(MetricLogger())
    model.learn(60)
    recorded = model.logger.name_to_value
    names = "critic_loss actor_loss ent_coef ent_coef_loss q_mean target_critic_variance".split()
    assert {f"train/{name}" for name in names} <= set(recorded)
    observations = model.get_env().reset()
    actions, _ = model.predict(observations, deterministic=True)
    assert model.q_values(observations, actions).shape == (1, 3)
    assert np.isfinite(model.log_prob(observations, actions)).all()


def test_random_actions_are_as_frequent_as_asked(make: Any) -> None:
    model = make(n_envs=4, random_actions=1.0, learning_starts=4)
    model.learn(4)
    tight = [model.explore().numpy() for _ in range(200)]
    assert np.std(tight) == pytest.approx(1 / np.sqrt(3), abs=0.05)  # uniform in [-1, 1]


def test_ent_coef_of_zero_is_allowed(make: Any) -> None:
    model = make(ent_coef=0.0)
    model.set_logger(MetricLogger())
    model.learn(60)
    assert np.isfinite(float(model.logger.name_to_value["train/actor_loss"]))


def imitation(q_filter: bool, is_demo: list[float], preference: float) -> float:
    """Return the loss of an actor that always answers tanh(0) = 0 for demonstrated 0.5 and 1.

    The critics' only weight is that of the first action: its sign says which action is better.
    """
    actor = [{"weight": np.zeros((1, 2), np.float32), "bias": np.zeros(2, np.float32)}]
    critic = [{"weight": np.array([[[0.0], [preference]]], np.float32),
               "bias": np.zeros((1, 1, 1), np.float32)}]  # fmt: skip
    zeros = np.zeros(2, np.float32)
    batch = Batch(
        observations=np.zeros((2, 1), np.float32), actions=np.array([[0.5], [1.0]], np.float32),
        rewards=zeros, next_observations=np.zeros((2, 1), np.float32), dones=zeros,
        return_bounds=zeros, is_demo=np.array(is_demo, np.float32),
    )  # fmt: skip
    chosen = settings(bc_weight=1.0, q_filter=q_filter)
    return float(jaxsac.cloning_loss(actor, chosen, {"critic": critic}, batch))


@pytest.mark.parametrize(
    ("q_filter", "is_demo", "preference", "expected"),
    [
        (False, [1.0, 1.0], -1.0, 0.625),  # (0.25 + 1) / 2
        (False, [1.0, 0.0], -1.0, 0.25),  # the mean over demonstrations, here one
        (False, [0.0, 0.0], -1.0, 0.0),
        (True, [1.0, 1.0], 1.0, 0.625),  # the critics find 0.5 and 1 better than 0
        (True, [1.0, 1.0], -1.0, 0.0),  # or worse
    ],
)
def test_imitation_by_hand(q_filter, is_demo, preference, expected) -> None:
    assert imitation(q_filter, is_demo, preference) == pytest.approx(expected)


def test_imitation_moves_the_actor_and_needs_demonstrations(make: Any) -> None:
    state, batch = a_state(), a_batch()._replace(is_demo=np.ones(BATCH, np.float32))
    state["actor_losses"]["bc_loss"] = jnp.float32(0)
    plain, _ = jaxsac.update(settings(), state, batch, KEY, 0)
    cloning = settings(bc_weight=100.0, q_filter=False)
    moved, losses = jaxsac.update(cloning, state, batch, KEY, 0)
    assert float(losses["bc_loss"]) > 0
    before = jaxsac.cloning_loss(state["actor"], cloning, state, batch)
    after = jaxsac.cloning_loss(moved["actor"], cloning, moved, batch)
    assert after < before
    assert not np.array_equal(plain["actor"][0]["weight"], moved["actor"][0]["weight"])
    model = make(bc_weight=1.0)
    with pytest.raises(ConfigError, match="needs demonstrations"):
        model.more_fields(4)
