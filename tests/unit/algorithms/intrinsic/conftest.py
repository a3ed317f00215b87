"""Agents without an algorithm, for equations; and algorithms of the contract test."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from scilab_rl.algorithms.intrinsic.agents import OneFileAgent
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.testing.algorithms import AlgorithmContract, _differences

PLAIN = {"normalize": "none", "normalize_states": False}


@pytest.fixture
def agent() -> OneFileAgent:
    """Two state dimensions, one action dimension, no critics."""
    return agent_with(spaces.Box(-1.0, 1.0, (1,)))


def agent_with(action_space: spaces.Space, critic: Any = None) -> OneFileAgent:
    algorithm = SimpleNamespace(
        observation_space=spaces.Box(-9.0, 9.0, (2,)),
        action_space=action_space,
        device=torch.device("cpu"),
        logger=MetricLogger(),
        n_observations=2,
        n_actions=1,
    )
    if critic is not None:
        algorithm.action_values = critic
    return OneFileAgent(algorithm)


@pytest.fixture
def contract() -> Callable[..., AlgorithmContract]:
    """Return a function that makes the contract test of an algorithm with an intrinsic reward."""

    def prepare(algorithm: str, intrinsic: Any = None, **arguments: Any) -> AlgorithmContract:
        contract = AlgorithmContract()
        contract.algorithm = algorithm
        contract.arguments = {"intrinsic": intrinsic, **arguments}
        return contract

    return prepare


def small(name: str, **settings: Any) -> dict[str, Any]:
    """Return the configuration of an intrinsic reward with small networks."""
    networks = {} if name == "critic_variance" else {"net_arch": [8]}
    return {"name": name, **networks, **settings}


def differences_of_the_learner(one: Any, other: Any) -> list[str]:
    """Compare two algorithms bit for bit, apart from what belongs to intrinsic rewards."""
    return [name for name in _differences(one, other) if ".intrinsic." not in name]


def set_linear(layer: torch.nn.Linear, weight: Any, bias: Any) -> None:
    """Give a layer known weights."""
    with torch.no_grad():
        layer.weight.copy_(torch.as_tensor(np.asarray(weight), dtype=torch.float32))
        layer.bias.copy_(torch.as_tensor(np.asarray(bias), dtype=torch.float32))
