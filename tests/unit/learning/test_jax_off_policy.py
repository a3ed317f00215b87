"""Exploration of the compiled algorithms: random actions that shrink with success."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("jax")

from scilab_rl.envs.vec_step import VecStep
from scilab_rl.errors import ConfigError
from scilab_rl.learning.jax_off_policy import JaxOffPolicyAlgorithm
from scilab_rl.testing.algorithms import AlgorithmContract
from scilab_rl.training.snapshot import capture, restore


@pytest.fixture(params=["jaxsac", "jaxtd3"])
def contract(request: pytest.FixtureRequest) -> AlgorithmContract:
    contract = AlgorithmContract()
    contract.algorithm, contract.env = request.param, "scilab_rl.testing:TinyReach-v0"
    contract.arguments = {"random_actions": 0.4, "random_actions_end": 0.1}
    return contract


def build(contract: AlgorithmContract, n_envs: int) -> JaxOffPolicyAlgorithm:
    model = contract.build(n_envs=n_envs)
    assert isinstance(model, JaxOffPolicyAlgorithm)
    return model


def store(model: JaxOffPolicyAlgorithm, *successes: bool, ended: bool) -> None:
    """Store a step of all environments, which reports these successes."""
    observations, n = model.get_env().reset(), model.n_envs
    actions, infos = np.zeros((n, 2), np.float32), [{"is_success": value} for value in successes]
    step = VecStep(
        observations, actions, np.zeros(n), np.zeros(n, bool), np.full(n, ended), infos,
        observations, observations,
    )  # fmt: skip
    model.store(step, actions)


def test_the_share_follows_the_success_rate_in_training(contract: AlgorithmContract) -> None:
    model = build(contract, n_envs=2)
    assert model.random_share == 0.4
    store(model, True, False, ended=False)
    assert model.training_success == 0.0  # no episode has ended
    store(model, False, True, ended=True)  # the first one has left its goal again
    assert model.training_success == pytest.approx(0.05 + 0.05 * 0.95)
    store(model, False, False, ended=True)
    assert model.training_success == pytest.approx(0.0975 * 0.95**2)
    assert model.random_share == pytest.approx(0.4 - 0.3 * 0.0975 * 0.95**2)
    model.training_success = 1.0
    assert model.random_share == pytest.approx(0.1)


def test_as_many_actions_are_random(contract: AlgorithmContract) -> None:
    model = build(contract, n_envs=2)
    model._last_obs, model.num_timesteps = model.get_env().reset(), 100
    model.training_success = 0.5
    model.draw_random_actions = lambda: torch.full((2, 2), 9.0)  # type: ignore[method-assign]
    random = [(model.explore() == 9.0).float().mean() for _ in range(1000)]
    assert np.mean(random) == pytest.approx(0.25, abs=0.04)


def test_the_success_rate_is_in_the_checkpoint(contract: AlgorithmContract, tmp_path: Path) -> None:
    model, resumed = build(contract, n_envs=1), build(contract, n_envs=1)
    store(model, True, ended=True)
    store(model, True, ended=False)
    restore({"algorithm": resumed}, capture({"algorithm": model}))
    assert resumed.training_success == 0.05
    store(resumed, False, ended=True)
    assert resumed.training_success == pytest.approx(0.05 + 0.05 * 0.95)
    contract.test_continues_as_if_it_had_not_been_interrupted(tmp_path)


def test_the_share_is_constant_by_default(contract: AlgorithmContract) -> None:
    contract.arguments = {"random_actions": 0.4}
    model = build(contract, n_envs=1)
    model.training_success = 1.0
    assert model.random_share == 0.4
    contract.arguments = {"random_actions_end": 1.5}
    with pytest.raises(ConfigError, match="random_actions_end must be from 0 to 1"):
        contract.build()
