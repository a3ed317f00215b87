from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from scilab_rl.algorithms import onestepac
from scilab_rl.algorithms.onestepac import ONESTEPAC
from scilab_rl.envs.vec_step import VecStep
from scilab_rl.errors import NumericalError


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(n_envs: int = 1, **kwargs: Any) -> ONESTEPAC:
        env = make_env("TinyDiscrete-v0", n_envs)
        return ONESTEPAC(env=env, seed=1, device="cpu", **({"net_arch": [8]} | kwargs))

    return make_model


def weights(model: ONESTEPAC) -> list[torch.Tensor]:
    modules = (model.actor, model.critic)
    return [p.detach().clone() for module in modules for p in module.parameters()]


def step_to(dones: list[bool], terminated: list[bool], reward: float = 1.0) -> VecStep:
    n = len(dones)
    observations = np.full((n, 2), 0.3, np.float32)
    next_observations = np.full((n, 2), -0.4, np.float32)
    rewards = np.full(n, reward)
    infos: list[dict[str, Any]] = [{} for _ in range(n)]
    truncated = np.array(dones) & ~np.array(terminated)
    return VecStep(
        observations, np.zeros(n), rewards, np.array(terminated), truncated, infos,
        next_observations, observations,
    )  # fmt: skip


def test_target_by_hand() -> None:
    targets = onestepac.td_target(
        torch.tensor([1.0, 1.0]), torch.tensor([0.0, 1.0]), torch.tensor([4.0, 4.0]), gamma=0.5
    )
    assert targets.tolist() == [3.0, 1.0]


@pytest.mark.parametrize("terminated", [True, False])
def test_losses_by_hand(make: Any, terminated: bool) -> None:
    model = make(gamma=0.5)
    step = step_to([True], [terminated], reward=2.0)
    value, next_value = model.value(step.observations), model.value(step.next_observations)
    log_prob = model.policy(torch.as_tensor(step.observations)).log_prob(torch.tensor([1]))
    delta = 2.0 + (0.0 if terminated else 0.5 * next_value.item()) - value.item()
    model.discounts.fill_(0.25)
    model.train(step, torch.tensor([1]))
    recorded = model.logger.take()
    assert recorded["train/td_error"] == pytest.approx(delta, abs=1e-6)
    assert recorded["train/critic_loss"] == pytest.approx(0.5 * delta**2, abs=1e-6)
    expected = -0.25 * delta * log_prob.item()
    assert recorded["train/actor_loss"] == pytest.approx(expected, abs=1e-6)


def test_discount_of_updates_grows_smaller_until_the_episode_ends(make: Any) -> None:
    model = make(n_envs=2, gamma=0.5)
    actions = torch.tensor([0, 1])
    model.train(step_to([False, False], [False, False]), actions)
    assert model.discounts.tolist() == [0.5, 0.5]
    model.train(step_to([False, True], [False, False]), actions)
    assert model.discounts.tolist() == [0.25, 1.0]


def test_without_discount_late_steps_count_as_much(make: Any) -> None:
    losses = []
    for discount_updates in (True, False):
        model = make(gamma=0.5, discount_updates=discount_updates)
        model.discounts.fill_(0.25)
        model.train(step_to([False], [False]), torch.tensor([0]))
        losses.append(model.logger.take()["train/actor_loss"])
    assert losses[0] == pytest.approx(0.25 * losses[1])


def test_a_good_surprise_makes_the_action_more_likely(make: Any) -> None:
    model = make(learning_rate=0.01)
    step = step_to([True], [True], reward=10.0)
    observation = torch.as_tensor(step.observations)
    before = model.policy(observation).probs[0, 1].item()
    model.train(step, torch.tensor([1]))
    assert model.policy(observation).probs[0, 1].item() > before


def test_it_learns_after_every_step(make: Any) -> None:
    model = make(n_envs=2)
    before = weights(model)
    model.learn(40)
    assert model.n_updates == 20
    assert not any(map(torch.equal, before, weights(model)))


def test_it_finds_the_door_that_pays(make: Any) -> None:
    model = make(n_envs=4, learning_rate=3e-3, critic_learning_rate=1e-2, net_arch=[16])
    model.learn(6000)
    sides = np.float32([[0.0, -1.0], [0.0, 1.0]])
    assert model.predict(sides, deterministic=True)[0].tolist() == [0, 1]


def test_a_seed_determines_the_weights(make: Any) -> None:
    first, second = (weights(make().learn(60)) for _ in range(2))
    assert all(map(torch.equal, first, second))


def test_a_poisoned_weight_stops_learning(make: Any) -> None:
    model = make()
    with torch.no_grad():
        model.critic[0].weight.fill_(float("nan"))
    with pytest.raises(NumericalError, match="critic_loss is nan at update 1"):
        model.learn(5)
