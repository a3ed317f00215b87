"""The losses of implicit Q-learning by hand, and a learner that never acts."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

jax = pytest.importorskip("jax")

import jax.numpy as jnp  # noqa: E402

from scilab_rl.algorithms import jaxgciql  # noqa: E402
from scilab_rl.algorithms.jaxgciql import Settings  # noqa: E402
from scilab_rl.config.compose import compose  # noqa: E402
from scilab_rl.envs.vectorize import make_train_env, observed_layer  # noqa: E402
from scilab_rl.errors import ConfigError  # noqa: E402
from scilab_rl.learning.inspector import AgentInspector  # noqa: E402
from scilab_rl.learning.jax_engine import Batch  # noqa: E402
from scilab_rl.run.checks import complete  # noqa: E402
from scilab_rl.run.demonstrations import collect_demos, prepare_demos  # noqa: E402
from scilab_rl.run.directory import RunDirectory  # noqa: E402
from scilab_rl.run.parts import make_algorithm  # noqa: E402
from scilab_rl.run.run import resume_run, start_run  # noqa: E402

KEY = jax.random.key(0)
REACH = "scilab_rl.testing:TinyReach-v0"
SMALL = ["algorithm.net_arch=[8]", "algorithm.batch_size=8", "algorithm.train_freq=10",
         "tuned=false", "seed=3"]  # fmt: skip


def settings(**changed: Any) -> Settings:
    usual = {
        "learning_rate": 0.1, "gamma": 0.5, "tau": 0.25, "n_target_critics": 2, "policy_delay": 1,
        "precision": "float32", "expectile": 0.75, "inverse_temperature": 2.0,
    }  # fmt: skip
    return Settings(**(usual | changed))


def linear(weights: list[float]) -> Any:
    return [{"weight": jnp.array(weights)[:, None], "bias": jnp.zeros(1)}]


def state() -> Any:
    """V(s) = s, Q_1(s, a) = s + a and Q_2(s, a) = 2 s + a, pi(s) = tanh(0)."""
    critic = [{"weight": jnp.array([[[1.0], [1.0]], [[2.0], [1.0]]]), "bias": jnp.zeros((2, 1, 1))}]
    return jaxgciql.initial_state(linear([0.0]), critic, linear([1.0]), 0.1)


def batch() -> Batch:
    column = np.array([[1.0], [-1.0]], np.float32)
    return Batch(
        observations=column,
        actions=np.array([[0.5], [-0.25]], np.float32),
        rewards=np.array([-1.0, 0.0], np.float32),
        next_observations=2 * column,
        dones=np.array([0.0, 1.0], np.float32),
        return_bounds=np.array([-2.0, 0.0], np.float32),
    )


def test_an_expectile_weighs_what_is_above_by_tau_and_what_is_below_by_the_rest() -> None:
    losses = jaxgciql.expectile_loss(jnp.array([2.0, -2.0, 0.0]), 0.75)
    np.testing.assert_allclose(losses, [0.75 * 4, 0.25 * 4, 0.0])


def test_the_expectile_that_minimizes_the_loss_is_between_mean_and_maximum() -> None:
    """Of 0 and 1, tau (1 - v) = (1 - tau) v: v = tau."""
    grid = jnp.linspace(0, 1, 101)
    for expectile in (0.5, 0.9):
        losses = [
            float(jaxgciql.expectile_loss(jnp.array([0.0, 1.0]) - v, expectile).sum()) for v in grid
        ]
        assert float(grid[int(np.argmin(losses))]) == pytest.approx(expectile)


def test_value_follows_the_data() -> None:
    """u = 1.5 - 1 and -2.25 + 1: the first is above the value, the second below."""
    loss = jaxgciql.value_loss(linear([1.0]), settings(), batch(), jnp.array([1.5, -2.25]))
    assert float(loss) == pytest.approx((0.75 * 0.5**2 + 0.25 * 1.25**2) / 2)


def test_better_actions_are_imitated_more_and_none_without_end() -> None:
    weights = jaxgciql.advantage_weights(jnp.array([0.5, -1.0, 9.0]), 2.0)
    np.testing.assert_allclose(weights, [math.exp(1), math.exp(-2), 100.0], rtol=1e-6)
    cloning = jaxgciql.advantage_weights(jnp.array([0.5, -1.0, 9.0]), 0.0)
    np.testing.assert_array_equal(cloning, 1.0)


def test_actor_is_pulled_to_the_data_by_the_weights() -> None:
    loss = jaxgciql.actor_loss(linear([0.0]), settings(), batch(), jnp.array([2.0, 4.0]))
    assert float(loss) == pytest.approx((2 * 0.5**2 + 4 * 0.25**2) / 2)


def test_an_update_asks_in_the_order_value_actor_critics() -> None:
    before = state()
    after, losses = jaxgciql.update(settings(), before, batch(), KEY, jnp.uint32(0))
    q = np.array([1.5, -2.25])  # the smaller of (1.5, 2.5) and of (-1.25, -2.25)
    assert float(losses["value_loss"]) == pytest.approx((0.75 * 0.25 + 0.25 * 1.25**2) / 2)
    # Adam's first step is the learning rate: dL/dweight < 0 and dL/dbias = 0.125 - ... < 0.
    weight, bias = (float(after["value"][0][k].squeeze()) for k in ("weight", "bias"))
    gradient = np.array([-2 * 0.75 * 0.5, 2 * 0.25 * 1.25]) / 2  # of V at each step
    assert weight == pytest.approx(1 - 0.1 * np.sign(gradient @ [1, -1]), rel=1e-4)
    assert bias == pytest.approx(-0.1 * np.sign(gradient.sum()), rel=1e-4)
    advantages = q - (weight * np.array([1, -1]) + bias)
    assert float(losses["advantage"]) == pytest.approx(advantages.mean(), rel=1e-4)
    weights = np.exp(2 * advantages)
    assert float(losses["advantage_weight"]) == pytest.approx(weights.mean(), rel=1e-4)
    squares = np.array([0.5, 0.25]) ** 2
    assert float(losses["actor_loss"]) == pytest.approx((weights * squares).mean(), rel=1e-4)
    # y is clipped to [-2, 0]; after the second step there is nothing.
    targets = np.clip([-1 + 0.5 * (2 * weight + bias), 0.0], -2, 0)
    expected = np.square(np.array([[1.5, -1.25], [2.5, -2.25]]) - targets).mean(axis=1).sum()
    assert float(losses["critic_loss"]) == pytest.approx(expected, rel=1e-4)
    moved = after["critic"][0]["weight"]
    np.testing.assert_allclose(
        after["critic_target"][0]["weight"],
        0.75 * before["critic"][0]["weight"] + 0.25 * moved,
        rtol=1e-5,
    )
    assert (after["actor"][0]["weight"] != before["actor"][0]["weight"]).any()


def build(data: str, *more: str) -> Any:
    words = [f"env={REACH}", "algorithm=jaxgciql", f"algorithm.data={data}", *SMALL, *more]
    cfg = complete(compose(words))
    model = make_algorithm(cfg, make_train_env(cfg))
    prepare_demos(cfg, model)
    collect_demos(cfg, model)
    return model


def test_it_never_steps_its_environments_and_counts_updates() -> None:
    model = build("random:3")
    with closing(model.get_env()):
        model.learn(40)
        assert model.num_timesteps == model.n_updates == 40
        assert observed_layer(model.get_env()).step_count == 0
        assert model.replay_buffer.pos == 0  # and experiences nothing


def test_data_are_all_episodes_and_the_normalizer_knows_them() -> None:
    """Random episodes seldom succeed; a demonstration would be one that does."""
    model = build("random:5")
    with closing(model.get_env()):
        ring = model.replay_buffer.demos
        _, start, _ = ring._cursors[:, 0]
        assert model.normalizer.count == start
        assert np.ptp(ring.actions[:start]) > 1.5  # over all of [-1, 1]
        others = build("random:5", "seed=4").replay_buffer.demos
        assert not np.array_equal(others.actions, ring.actions)
        again = build("random:5").replay_buffer.demos
        np.testing.assert_array_equal(again.rows, ring.rows)


def test_its_value_is_asked_of_its_own_network() -> None:
    model = build("random:3")
    with closing(model.get_env()):
        model.learn(20)
        inspector = AgentInspector(model)
        assert {"q_values", "value", "second critic"} <= inspector.quantities
        observations = model.get_env().reset()
        one = {key: values[0] for key, values in observations.items()}
        vector = model.normalizer(model.to_vector(observations).numpy())
        hidden = np.maximum(vector @ model.rounds.networks["value"][0]["weight"]
                            + model.rounds.networks["value"][0]["bias"], 0)  # fmt: skip
        last = model.rounds.networks["value"][1]
        assert inspector.value(one) == pytest.approx(
            (hidden @ last["weight"] + last["bias"]).item(), rel=1e-5
        )


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("null", "learns from a data set alone; name one: algorithm.data=scripted:100"),
        ("random", "algorithm.data must be scripted:100, random:100"),
        ("randm:3", "Did you mean 'random'"),
        ("scripted:3", "no scripted controller"),
    ],
)
def test_without_data_it_does_not_begin(data: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(data)


def test_others_have_no_random_demonstrations() -> None:
    words = [f"env={REACH}", "algorithm=cleansac", "algorithm.demos=random:3", "tuned=false"]
    cfg = complete(compose(words))
    model = make_algorithm(cfg, make_train_env(cfg))
    with closing(model.get_env()), pytest.raises(ConfigError, match=r"algorithm\.demos must be"):
        prepare_demos(cfg, model)


def test_a_run_that_is_continued_ends_as_one_that_was_not_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    words = [f"env={REACH}", "algorithm=jaxgciql", "algorithm.data=random:3", *SMALL, "mlflow=0",
             "eval_after_n_steps=50", "n_test_rollouts=2", "early_stop_threshold=2",
             "++tracking.console.enabled=false", "save_model_freq=1"]  # fmt: skip
    whole = start_run(compose([*words, "n_epochs=2"]))
    half = start_run(compose([*words, "n_epochs=1"]))
    directory = RunDirectory(Path(half.run_dir))
    # A resumed run has its data in its checkpoint.
    monkeypatch.setattr("scilab_rl.run.run.collect_demos", None)
    resumed = resume_run(compose([*words, "n_epochs=2"]), directory)
    assert resumed.steps == whole.steps == 100
    timeless = {k: v for k, v in whole.metrics.items() if not k.startswith("time/")}
    assert {k: v for k, v in resumed.metrics.items() if k in timeless} == timeless
    assert not any(name.startswith("rollout/") for name in timeless)
    assert "train/value_loss" in timeless
