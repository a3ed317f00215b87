"""Random network distillation (RND): rewarded for states that a network does not know yet.

Burda et al., 2018, "Exploration by Random Network Distillation", arXiv 1810.12894, section 2.2.
A fixed random network f says something about each state, and a predictor f^ learns to say the same:

    r_i = || f^(s') - f(s') ||^2,        loss = E[r_i].

The prediction fails in states unlike those seen before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from scilab_rl.algorithms.intrinsic.agents import Agent
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.learning.nn import network
from scilab_rl.learning.observations import Tensors


class RandomNetworkDistillation(IntrinsicReward):
    """The error in predicting a random network.

    Args:
        agent: The algorithm.
        learning_rate: Of the predictor.
        n_features: Length of what the random network says.
        net_arch: Sizes of the hidden layers of both networks.
        **common: See `IntrinsicReward`.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        learning_rate: float = 1e-4,
        n_features: int = 64,
        net_arch: Sequence[int] = (256, 256),
        **common: Any,
    ) -> None:
        super().__init__(agent, **common)
        sizes = [agent.n_states, *net_arch, n_features]
        self.target = network(sizes).to(agent.device).requires_grad_(False)
        self.predictor = network(sizes).to(agent.device)
        self.optimizer = torch.optim.Adam(self.predictor.parameters(), learning_rate)

    @torch.no_grad()
    def reward(self, observations: Tensors, actions: Tensor, next_observations: Tensors) -> Tensor:
        """Return || f^(s') - f(s') ||^2."""
        _, _, next_states = self.vectors(observations, actions, next_observations)
        return squared_distance(self.predictor(next_states), self.target(next_states))

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return the mean of the reward."""
        return squared_distance(self.predictor(next_states), self.target(next_states)).mean()


def squared_distance(one: Tensor, other: Tensor) -> Tensor:
    """Return the squared Euclidean distance. Shapes: ``(batch, n)`` twice to ``(batch,)``."""
    return (one - other).square().sum(dim=1)
