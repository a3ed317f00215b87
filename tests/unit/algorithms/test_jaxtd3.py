from __future__ import annotations

from typing import Any

import numpy as np
import pytest

jax = pytest.importorskip("jax")

import jax.numpy as jnp  # noqa: E402

from scilab_rl.algorithms import jaxtd3  # noqa: E402
from scilab_rl.algorithms.jaxtd3 import JAXTD3, Settings  # noqa: E402
from scilab_rl.learning.jax_engine import Batch  # noqa: E402
from scilab_rl.learning.replay import HindsightReplayBuffer  # noqa: E402

KEY = jax.random.key(0)


def settings(**changed: Any) -> Settings:
    usual = {
        "learning_rate": 0.1,
        "gamma": 0.5,
        "tau": 0.25,
        "n_target_critics": 2,
        "policy_delay": 1,
        "target_policy_noise": 0.0,
        "target_noise_clip": 0.5,
        "action_penalty": 0.0,
        "precision": "float32",
    }
    return Settings(**(usual | changed))


def linear(*weights: list[float]) -> Any:
    """Critics Q_i(s, a) = w_i . (s, a), or with one row of weights per network: one layer."""
    return [{"weight": jnp.array(weights)[..., None], "bias": jnp.zeros((len(weights), 1, 1))}]


def one_layer(gain: float) -> Any:
    """A policy tanh(gain s)."""
    return [{"weight": jnp.array([[gain]]), "bias": jnp.zeros(1)}]


def batch(**changed: Any) -> Batch:
    usual = {
        "observations": np.array([[2.0]]),
        "actions": np.array([[0.5]]),
        "rewards": np.array([-1.0]),
        "next_observations": np.array([[1.0]]),
        "dones": np.array([0.0]),
        "return_bounds": np.array([-np.inf, np.inf]),
    }
    arrays = usual | changed
    return Batch(**{name: np.asarray(value, np.float32) for name, value in arrays.items()})


def targets(chosen: Settings, given: Batch) -> np.ndarray:
    state = {"actor_target": one_layer(0.0), "critic_target": linear([3.0, 1.0], [1.0, 2.0])}
    return np.array(jaxtd3.smoothed_targets(chosen, state, given, KEY)[0])


def test_target_is_the_smallest_critic_of_the_target_policy() -> None:
    # pi'(s') = tanh(0) = 0; Q'_1 = 3 * 1 + 0, Q'_2 = 1 * 1 + 0; y = -1 + 0.5 * 1
    assert targets(settings(), batch()).tolist() == [-0.5]
    assert targets(settings(), batch(dones=[1.0])).tolist() == [-1.0]
    assert targets(settings(), batch(return_bounds=[-2.0, -0.75])).tolist() == [-0.75]


def test_target_noise_is_clipped() -> None:
    # With |noise| <= 0.01, Q'_2 = 1 + 2 a' is within 0.02 of 1.
    noisy = targets(settings(target_policy_noise=10.0, target_noise_clip=0.01), batch())
    assert noisy[0] == pytest.approx(-0.5 + 0.5 * 0.02, abs=1e-6) or noisy[0] == pytest.approx(
        -0.5 - 0.5 * 0.02, abs=1e-6
    )


def test_critic_loss_is_the_squared_error_of_each_critic() -> None:
    # Q_1 = 3 * 2 + 0.5 = 6.5, Q_2 = 2 + 1 = 3; (6.5 - 1)^2 + (3 - 1)^2 = 34.25
    loss, q = jaxtd3.squared_error(linear([3.0, 1.0], [1.0, 2.0]), batch(), np.ones(1), "float32")
    assert q[:, 0].tolist() == [6.5, 3.0]
    assert float(loss) == pytest.approx(34.25)


def test_actor_loss_is_minus_the_first_critic_plus_the_penalty() -> None:
    state = {"critic": linear([3.0, 1.0], [100.0, 100.0])}
    action = np.tanh(0.2 * 2.0)
    loss = jaxtd3.actor_loss(one_layer(0.2), settings(action_penalty=2.0), state, batch())
    assert float(loss) == pytest.approx(2 * action**2 - (3 * 2.0 + action), rel=1e-5)


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(n_envs: int = 1, **kwargs: Any) -> JAXTD3:
        small = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16, "net_arch": [8]}
        env = make_env("TinyReach-v0", n_envs)
        kwargs = small | {"replay_buffer_class": HindsightReplayBuffer, "seed": 1} | kwargs
        return JAXTD3(env=env, device="cpu", **kwargs)

    return make_model


def test_actor_and_both_target_networks_follow(make: Any) -> None:
    model = make(tau=0.5, policy_delay=2, overlap=False)
    before = jax.tree.map(np.array, model.rounds.state)
    model.learn(41)
    after = model.rounds.state
    for name in ("actor", "critic"):
        weight, old = (state[name][0]["weight"] for state in (after, before))
        assert (np.array(weight) != old).any()
        target = after[f"{name}_target"][0]["weight"]
        np.testing.assert_allclose(target, 0.5 * np.array(weight) + 0.5 * old, rtol=1e-5)


def test_exploration_is_the_policy_plus_noise(make: Any) -> None:
    model = make(n_envs=2, action_noise=0.1)
    observations = model.to_vector(model.get_env().reset())
    quiet = model.act(observations, deterministic=True).numpy()
    noisy = np.array([model.act(observations, deterministic=False).numpy() for _ in range(400)])
    assert (noisy - quiet).std() == pytest.approx(0.1, rel=0.1)
    assert np.abs(noisy).max() <= 1.0
