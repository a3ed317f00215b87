from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from scilab_rl.algorithms import cleanppo
from scilab_rl.algorithms.cleanppo import CLEANPPO
from scilab_rl.envs.vec_step import VecStep
from scilab_rl.errors import NumericalError


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(env_id: str = "TinyBox-v0", n_envs: int = 1, **kwargs: Any) -> CLEANPPO:
        small = {"n_steps": 16, "batch_size": 8, "n_epochs": 2, "net_arch": [8]}
        return CLEANPPO(env=make_env(env_id, n_envs), seed=1, device="cpu", **(small | kwargs))

    return make_model


def weights(model: CLEANPPO) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in model.networks.parameters()]


def rows(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(-1, 1)


def test_advantages_by_hand() -> None:
    # gamma = lambda = 0.5; deltas: 1 + 0.5 * 2 - 1 = 1;  1 + 0.5 * 4 - 2 = 1;  1 + 0.5 * 8 - 4 = 1
    # A_2 = 1;  A_1 = 1 + 0.25 * 1 = 1.25;  A_0 = 1 + 0.25 * 1.25 = 1.3125
    advantages = cleanppo.generalized_advantages(
        rewards=rows(1, 1, 1),
        values=rows(1, 2, 4),
        next_values=rows(2, 4, 8),
        terminated=rows(0, 0, 0),
        dones=rows(0, 0, 0),
        gamma=0.5,
        gae_lambda=0.5,
    )
    torch.testing.assert_close(advantages, rows(1.3125, 1.25, 1.0))


@pytest.mark.parametrize(("terminated", "delta_1"), [(1.0, 1 - 2), (0.0, 1 + 0.5 * 4 - 2)])
def test_advantages_stop_at_an_end_and_bootstrap_only_if_it_is_no_terminal_state(
    terminated: float, delta_1: float
) -> None:
    advantages = cleanppo.generalized_advantages(
        rewards=rows(1, 1, 1),
        values=rows(1, 2, 4),
        next_values=rows(2, 4, 8),
        terminated=rows(0, terminated, 0),
        dones=rows(0, 1, 0),
        gamma=0.5,
        gae_lambda=0.5,
    )
    torch.testing.assert_close(advantages, rows(1 + 0.25 * delta_1, delta_1, 1.0))


def test_lambda_one_gives_the_return_minus_the_value() -> None:
    advantages = cleanppo.generalized_advantages(
        rows(1, 2, 3), rows(5, 6, 7), rows(6, 7, 9), rows(0, 0, 1), rows(0, 0, 1), 0.5, 1.0
    )
    # the returns, from the last one: 3;  then 2 plus half of it;  then 1 plus half of that
    torch.testing.assert_close(advantages, rows(2.75 - 5, 3.5 - 6, 3 - 7))


def test_policy_loss_is_clipped_on_the_side_that_pays() -> None:
    # ratio 1.5, A = 1: min(1.5, 1.2) = 1.2;  ratio 1.5, A = -1: min(-1.5, -1.2) = -1.5
    # ratio 0.5, A = 1: min(0.5, 0.8) = 0.5;  ratio 0.5, A = -1: min(-0.5, -0.8) = -0.8
    log_ratio = torch.tensor([1.5, 1.5, 0.5, 0.5]).log()
    loss = cleanppo.clipped_policy_loss(log_ratio, torch.tensor([1.0, -1.0, 1.0, -1.0]), 0.2)
    assert loss.item() == pytest.approx(-(1.2 - 1.5 + 0.5 - 0.8) / 4)


def test_approximate_kl_by_hand() -> None:
    log_ratio = torch.tensor([0.0, math.log(2.0)])
    # (0 + (2 - 1 - ln 2)) / 2
    assert cleanppo.approximate_kl(log_ratio).item() == pytest.approx((1 - math.log(2.0)) / 2)


@pytest.mark.parametrize(
    ("values", "expected"),
    [([1.0, 2.0, 3.0], 1.0), ([2.0, 2.0, 2.0], 0.0), ([3.0, 2.0, 1.0], -3.0)],
)
def test_explained_variance(values: list[float], expected: float) -> None:
    returns = torch.tensor([1.0, 2.0, 3.0])
    result = cleanppo.explained_variance(torch.tensor(values), returns)
    assert result.item() == pytest.approx(expected)


def test_explained_variance_of_equal_returns_is_zero() -> None:
    assert cleanppo.explained_variance(torch.tensor([1.0, 2.0]), torch.ones(2)).item() == 0.0


def test_minibatches_use_each_step_once_per_epoch() -> None:
    indices = list(cleanppo.minibatches(n=10, batch_size=4, n_epochs=2))
    assert [len(batch) for batch in indices] == [4, 4, 2] * 2
    assert sorted(torch.cat(indices[:3]).tolist()) == list(range(10))


def test_a_rollout_bootstraps_from_the_state_that_a_truncated_episode_reached(make: Any) -> None:
    model = make(n_envs=1, gamma=0.5, gae_lambda=0.0)
    first, reached, next_first = (np.full((1, 4), x, np.float32) for x in (0.1, 0.5, -0.9))
    done, not_done = np.array([True]), np.array([False])
    action, reward = np.zeros((1, 2), np.float32), np.array([1.0])
    steps = [
        VecStep(first, action, reward, not_done, done, [{}], reached, next_first),  # truncated
        VecStep(next_first, action, reward, done, not_done, [{}], reached, first),  # terminated
    ]
    rollout = model.make_rollout(steps, torch.zeros(2, 1, 2))
    value = {name: model.value(obs).item() for name, obs in [("f", first), ("r", reached)]}
    expected = [1 + 0.5 * value["r"], 1.0]
    assert rollout.returns.tolist() == pytest.approx(expected, abs=1e-6)
    assert rollout.values[0].item() == pytest.approx(value["f"], abs=1e-6)


def test_probabilities_of_a_rollout_are_those_of_the_policy_that_acted(make: Any) -> None:
    model = make(n_envs=2, n_steps=8)
    seen: list[float] = []

    def look(_: Any, __: Any) -> bool:
        seen.append(model.logger.take()["train/rollout_logpi_step"])
        return True

    rollouts: list[Any] = []
    model.train = rollouts.append
    model.learn(16, callback=look)
    log_probs = rollouts[0].log_probs.reshape(8, 2)
    assert log_probs[:, 0].tolist() == pytest.approx(seen, abs=1e-5)
    assert rollouts[0].observations.shape == (16, 4)
    assert rollouts[0].actions.shape == (16, 2)


@pytest.mark.parametrize("env_id", ["TinyBox-v0", "TinyReach-v0", "TinyDiscrete-v0"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_learning_changes_policy_and_value_function(make: Any, env_id: str, n_envs: int) -> None:
    model = make(env_id, n_envs)
    before = weights(model)
    model.learn(32 * n_envs)
    assert model.n_updates == 2 * 2 * 2 * n_envs
    assert not any(map(torch.equal, before, weights(model)))
    values = model.logger.take()
    assert {"train/policy_loss", "train/value_loss", "train/entropy"} <= set(values)
    assert all(map(math.isfinite, values.values()))


@pytest.mark.parametrize("env_id", ["TinyBox-v0", "TinyDiscrete-v0"])
def test_a_seed_determines_the_weights(make: Any, env_id: str) -> None:
    first, second = (weights(make(env_id).learn(48)) for _ in range(2))
    assert all(map(torch.equal, first, second))


def test_a_target_kl_ends_the_epochs_early(make: Any) -> None:
    free = make(learning_rate=0.05, n_epochs=20).learn(16)
    held = make(learning_rate=0.05, n_epochs=20, target_kl=1e-4).learn(16)
    assert free.n_updates == 40
    assert 1 <= held.n_updates < 10


def test_first_policy_is_nearly_the_same_everywhere(make: Any) -> None:
    model = make(net_arch=[64, 64])
    observations = torch.randn(100, 4)
    assert model.networks.policy(observations).mode.abs().max() < 0.1


@pytest.mark.parametrize("env_id", ["TinyBox-v0", "TinyDiscrete-v0"])
def test_predicted_actions_are_in_the_space(make: Any, env_id: str) -> None:
    model = make(env_id).learn(16)
    space = model.action_space
    observations = np.stack([model.observation_space.sample() for _ in range(20)])
    for deterministic in (True, False):
        for action in model.predict(observations, deterministic=deterministic)[0]:
            action = int(action) if isinstance(space, spaces.Discrete) else action
            assert space.contains(action)


def test_entropy_and_value_of_a_batch(make: Any) -> None:
    model = make("TinyDiscrete-v0", net_arch=[4])
    observations = np.zeros((3, 2), np.float32)
    # A zero observation and zero biases give zero logits: two actions, equally likely.
    assert model.entropy(observations).tolist() == pytest.approx([math.log(2.0)] * 3)
    assert model.value(observations).shape == (3,)


def test_a_poisoned_weight_stops_learning(make: Any) -> None:
    model = make()
    with torch.no_grad():
        model.networks.critic[0].weight[0, 0] = float("nan")
    with pytest.raises(NumericalError, match=r"is nan at update \d+ \(learning_rate"):
        model.learn(16)
