from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import HerReplayBuffer

from scilab_rl.algorithms import cleandqn
from scilab_rl.algorithms.cleandqn import CLEANDQN
from scilab_rl.errors import NumericalError


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(env_id: str = "TinyDiscrete-v0", n_envs: int = 1, **kwargs: Any) -> CLEANDQN:
        small = {"buffer_size": 500, "learning_starts": 20, "batch_size": 16, "net_arch": [8]}
        return CLEANDQN(env=make_env(env_id, n_envs), seed=1, device="cpu", **(small | kwargs))

    return make_model


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(-1, 1)


def weights(module: torch.nn.Module) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in module.parameters()]


def test_target_by_hand() -> None:
    next_q = torch.tensor([[1.0, 5.0], [1.0, 5.0]])
    targets = cleandqn.q_target(column(1.0, 1.0), column(0.0, 1.0), next_q, gamma=0.5)
    torch.testing.assert_close(targets, column(3.5, 1.0))


@pytest.mark.parametrize(("loss", "expected"), [("huber", (0.125 + 2.5) / 2), ("mse", 9.25 / 2)])
def test_losses_by_hand(loss: str, expected: float) -> None:
    # errors 0.5 and 3; Huber: 0.5 * 0.25 and 3 - 0.5
    values = cleandqn.LOSSES[loss](column(0.5, 3.0), column(0.0, 0.0))
    assert values.item() == pytest.approx(expected)


def test_other_losses_are_refused(make: Any) -> None:
    with pytest.raises(ValueError, match="loss must be one of huber, mse, but it is 'l1'"):
        make(loss="l1")


@pytest.mark.parametrize(
    ("progress", "expected"), [(0.0, 1.0), (0.05, 0.75), (0.1, 0.5), (0.2, 0.5), (1.0, 0.5)]
)
def test_epsilon_falls_linearly_and_stays(progress: float, expected: float) -> None:
    epsilon = cleandqn.linear_schedule(progress, fraction=0.1, initial=1.0, final=0.5)
    assert epsilon == pytest.approx(expected)


def test_no_exploration_phase_is_no_division_by_zero() -> None:
    assert cleandqn.linear_schedule(0.0, fraction=0.0, initial=1.0, final=0.1) == 0.1


def test_epsilon_follows_the_steps_of_the_whole_training(make: Any) -> None:
    model = make(exploration_fraction=0.5, exploration_final_eps=0.0)
    model.learn(100, callback=lambda *_: model.num_timesteps < 25)
    assert model.exploration_rate == pytest.approx(0.5)
    model.learn(75, reset_num_timesteps=False, callback=lambda *_: model.num_timesteps < 40)
    assert model.exploration_rate == pytest.approx(0.2)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_actions_are_random_with_probability_epsilon(make: Any, epsilon: float) -> None:
    model = make(exploration_initial_eps=epsilon, exploration_final_eps=epsilon)
    observations = torch.zeros(20_000, 2)
    best = model.act(observations, deterministic=True)
    share = (model.act(observations, deterministic=False) != best).float().mean().item()
    assert share == pytest.approx(epsilon / 2, abs=0.015)  # every other random one is the best


def test_learning_changes_the_network_and_copies_it_at_the_interval(make: Any) -> None:
    model = make(target_update_interval=40, train_freq=4)
    first = weights(model.q_network)
    model.learn(36)
    assert all(map(torch.equal, first, weights(model.target_network)))
    assert not any(map(torch.equal, first, weights(model.q_network)))
    before_copy = weights(model.q_network)
    model.learn(4, reset_num_timesteps=False)
    assert all(map(torch.equal, before_copy, weights(model.target_network)))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_the_interval_counts_steps_of_all_environments(
    make: Any, n_envs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    copies: list[int] = []
    model = make(n_envs=n_envs, target_update_interval=40, train_freq=1)
    monkeypatch.setattr(cleandqn, "update_target", lambda *_: copies.append(model.num_timesteps))
    model.learn(120)
    assert len(copies) == 3
    assert all(step % 40 < n_envs for step in copies)


def test_hindsight_replay_with_discrete_actions(make: Any) -> None:
    kwargs = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 40}
    model = make("TinyReachDiscrete-v0", n_envs=2, **kwargs)
    before = weights(model.q_network)
    model.learn(100)
    assert not any(map(torch.equal, before, weights(model.q_network)))
    batch = model.sample(16)
    assert batch.actions.shape == (16, 1)
    assert set(batch.rewards.flatten().tolist()) <= {0.0, -1.0}


def test_a_seed_determines_the_weights(make: Any) -> None:
    first, second = (weights(make().learn(100).q_network) for _ in range(2))
    assert all(map(torch.equal, first, second))


def test_values_of_steps_and_of_states(make: Any) -> None:
    model = make()
    observations = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    both = [model.q_values(observations, np.full(5, action)).flatten() for action in (0, 1)]
    torch.testing.assert_close(model.value(observations), torch.maximum(*both))
    best, _ = model.predict(observations, deterministic=True)
    assert best.tolist() == (both[1] > both[0]).long().tolist()
    single, _ = model.predict(observations[0], deterministic=True)
    assert single.shape == ()
    assert int(single) == best[0]


def test_a_poisoned_weight_stops_learning(make: Any) -> None:
    model = make()
    model.learn(24)
    with torch.no_grad():
        model.target_network[0].weight.fill_(float("inf"))
    with pytest.raises(NumericalError, match=r"loss is (nan|inf) at update 2 \(learning_rate"):
        model.train(1)
