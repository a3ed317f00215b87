from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import HerReplayBuffer

from scilab_rl.algorithms import actor_critic
from scilab_rl.algorithms.actor_critic import ACTOR_CRITIC
from scilab_rl.errors import NumericalError
from scilab_rl.learning.nn import gradient_step

NETWORKS = ("actor", "critic", "actor_target", "critic_target")


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(env_id: str = "TinyBox-v0", n_envs: int = 1, **kwargs: Any) -> ACTOR_CRITIC:
        small = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16, "net_arch": [8]}
        return ACTOR_CRITIC(env=make_env(env_id, n_envs), seed=1, device="cpu", **(small | kwargs))

    return make_model


def weights(module: torch.nn.Module) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in module.parameters()]


def test_target_by_hand() -> None:
    targets = actor_critic.q_target(
        torch.tensor([[1.0], [1.0]]),
        torch.tensor([[0.0], [1.0]]),
        torch.tensor([[4.0], [4.0]]),
        gamma=0.5,
    )
    assert targets.flatten().tolist() == [3.0, 1.0]


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("env_id", ["TinyBox-v0", "TinyReach-v0"])
def test_learning_changes_all_networks(make: Any, env_id: str, n_envs: int) -> None:
    buffer = HerReplayBuffer if env_id == "TinyReach-v0" else None
    model = make(env_id, n_envs, replay_buffer_class=buffer)
    before = {name: weights(getattr(model, name)) for name in NETWORKS}
    model.learn(80)
    assert model.n_updates == 40 // n_envs
    for name in NETWORKS:
        assert not any(map(torch.equal, before[name], weights(getattr(model, name))))


def test_the_actor_climbs_the_critic(make: Any) -> None:
    model = make(learning_rate=0.01, gamma=0.0)
    observations = np.random.default_rng(0).uniform(-1, 1, (50, 4)).astype(np.float32)

    def value_of_policy() -> float:
        actions, _ = model.predict(observations, deterministic=True)
        return model.q_values(observations, actions).mean().item()

    model.learn(41)
    before = value_of_policy()
    for _ in range(50):
        batch = model.sample(64)
        actions = model.actor(batch.observations)
        loss = -model.action_values(batch.observations, actions).mean()
        gradient_step(model.actor_optimizer, loss)
    assert value_of_policy() > before


def test_noise_has_the_given_size_and_stays_within_bounds(make: Any) -> None:
    model = make(exploration_noise=0.2)
    observations = torch.zeros(5000, 4)
    quiet = model.act(observations, deterministic=True)
    noisy = model.act(observations, deterministic=False)
    assert (noisy - quiet).std().item() == pytest.approx(0.2, rel=0.05)
    loud = make(exploration_noise=10.0).act(observations, deterministic=False)
    assert loud.abs().max() == 1.0


def test_a_seed_determines_the_weights(make: Any) -> None:
    first, second = (weights(make().learn(80).actor) for _ in range(2))
    assert all(map(torch.equal, first, second))


def test_what_is_recorded(make: Any) -> None:
    model = make()
    model.learn(50)
    values = model.logger.take()
    assert set(values) == {"train/actor_loss", "train/critic_loss", "train/rollout_q_step"}
    assert np.isfinite(list(values.values())).all()


@pytest.mark.parametrize("name", NETWORKS)
def test_a_poisoned_weight_stops_learning(make: Any, name: str) -> None:
    model = make()
    model.learn(45)
    with torch.no_grad():
        next(getattr(model, name).parameters()).fill_(float("nan"))
    with pytest.raises(NumericalError, match=r"nan at update \d+ \(learning_rate"):
        model.train(1)
