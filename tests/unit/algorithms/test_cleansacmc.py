from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer

from scilab_rl.algorithms import cleansacmc
from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.algorithms.cleansacmc import CLEANSACMC
from scilab_rl.learning.nn import gradient_step
from scilab_rl.learning.observations import state_columns


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(env_id: str = "TinyBox-v0", cls: type = CLEANSACMC, **kwargs: Any) -> Any:
        small = {"buffer_size": 500, "learning_starts": 40, "batch_size": 16, "net_arch": [8]}
        return cls(env=make_env(env_id), seed=1, device="cpu", **(small | kwargs))

    return make_model


def test_divergence_by_hand() -> None:
    # dimension 1: p = N(0, 1), q = N(1, 2): ln 2 + (1 + 1) / 8 - 1/2;  dimension 2: p = q
    means = torch.tensor([[0.0, 3.0]]), torch.tensor([[1.0, 3.0]])
    log_stds = torch.tensor([[0.0, 0.5]]), torch.tensor([[math.log(2.0), 0.5]])
    result = cleansacmc.gaussian_kl(means[0], log_stds[0], means[1], log_stds[1])
    assert result.shape == (1, 1)
    assert result.item() == pytest.approx(math.log(2.0) + 0.25 - 0.5)


def test_divergence_equals_that_of_torch() -> None:
    torch.manual_seed(0)
    mean_p, log_std_p, mean_q, log_std_q = (torch.randn(6, 3) for _ in range(4))
    p = torch.distributions.Normal(mean_p, log_std_p.exp())
    q = torch.distributions.Normal(mean_q, log_std_q.exp())
    expected = torch.distributions.kl_divergence(p, q).sum(dim=1, keepdim=True)
    result = cleansacmc.gaussian_kl(mean_p, log_std_p, mean_q, log_std_q)
    torch.testing.assert_close(result, expected)


def test_likelihood_by_hand() -> None:
    # N(3; 1, 2): 0.5 * 1 + ln 2 + 0.5 ln 2 pi, the same in both dimensions
    mean, log_std = torch.full((4, 2), 1.0), torch.full((4, 2), math.log(2.0))
    result = cleansacmc.gaussian_nll(torch.full((4, 2), 3.0), mean, log_std)
    expected = 2 * (0.5 + math.log(2.0) + 0.5 * math.log(2 * math.pi))
    assert result.item() == pytest.approx(expected)


def test_a_desired_goal_is_no_part_of_the_body() -> None:
    box = spaces.Box(-1, 1, (2,))
    space = spaces.Dict({"achieved_goal": box, "desired_goal": box, "observation": box})
    assert state_columns(space) == [0, 1, 4, 5]
    assert state_columns(box) == [0, 1]


def test_settings_are_completed_and_checked() -> None:
    settings = cleansacmc.complete_settings({"reward_eta": 0.5})
    assert settings == {"reward_eta": 0.5, "learning_rate": 1e-3, "net_arch": (256,)}
    with pytest.raises(ValueError, match=r"mc has no \['eta'\]; it has reward_eta"):
        cleansacmc.complete_settings({"eta": 0.5})


def test_rewards_grow_by_the_weighted_divergence(make: Any) -> None:
    model = make(mc={"reward_eta": 0.5})
    model.learn(45)
    batch = model.sample(16)
    batch = batch._replace(dones=torch.ones_like(batch.dones))
    divergence = model.morphological_computation(batch.observations, batch.actions)
    assert (divergence >= 0).all()
    targets = model.compute_targets(batch)
    torch.testing.assert_close(targets, batch.rewards + 0.5 * divergence)


def test_divergence_grows_where_the_state_matters_and_not_the_action(make: Any) -> None:
    # TinyBox: the next place is the place plus a quarter of the action, so that the state tells
    # a lot that the action does not.
    model = make(mc={"learning_rate": 0.01, "net_arch": [32]})
    model.learn(300)
    batch = model.sample(200)
    with torch.no_grad():
        before = model.model_loss(batch).item()
    for _ in range(300):
        gradient_step(model.model_optimizer, model.model_loss(model.sample(64)))
    with torch.no_grad():
        assert model.model_loss(batch).item() < before - 1
    assert model.morphological_computation(batch.observations, batch.actions).mean() > 1


@pytest.mark.parametrize("env_id", ["TinyBox-v0", "TinyReach-v0"])
def test_learning_changes_the_models_and_records(make: Any, env_id: str) -> None:
    buffer = HerReplayBuffer if env_id == "TinyReach-v0" else None
    model = make(env_id, replay_buffer_class=buffer)
    networks = (model.models.state_action, model.models.action, model.actor)
    before = [next(network.parameters()).detach().clone() for network in networks]
    model.learn(60)
    for old, network in zip(before, networks, strict=True):
        assert not torch.equal(old, next(network.parameters()))
    values = model.logger.take()
    assert {"train/morphological_computation", "train/mc_model_loss"} <= set(values)
    assert values["train/rollout_mc_step"] >= 0
    assert all(map(math.isfinite, values.values()))


def test_without_weight_the_rewards_are_those_of_the_task(make: Any) -> None:
    model = make(mc={"reward_eta": 0.0})
    plain = make(cls=CLEANSAC)
    for agent in (model, plain):
        agent.learn(45)
    batch = plain.sample(16)
    batch = batch._replace(dones=torch.ones_like(batch.dones))
    torch.testing.assert_close(model.compute_targets(batch), plain.compute_targets(batch))


def test_intrinsic_reward_of_steps(make: Any) -> None:
    model = make()
    observations, actions = np.zeros((3, 4), np.float32), np.ones((3, 2), np.float32)
    rewards = model.intrinsic_reward(observations, actions)
    assert rewards.shape == (3,)
    expected = model.morphological_computation(torch.zeros(3, 4), torch.ones(3, 2))
    torch.testing.assert_close(rewards, expected.flatten())
