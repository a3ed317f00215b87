"""Morphological computation: rewarded for what the body does beyond what the action prescribes.

Zahedi and Ay, 2013, "Quantifying Morphological Computation", Entropy 15, MC_W; two networks that
give normal distributions learn by maximum likelihood:

    r_i = KL(p(s'|s, a) || p(s'|a)),    loss = E[-log p(s'|s, a) - log p(s'|a)].

The algorithm ``cleansacmc`` is the same idea, with the models of its own batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from scilab_rl.algorithms.cleansacmc import NextStateModels
from scilab_rl.algorithms.intrinsic.agents import Agent
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.learning.observations import Tensors


class MorphologicalComputation(IntrinsicReward):
    """The divergence of two models of the next state, with and without the state.

    Args:
        agent: The algorithm.
        learning_rate: Of both models.
        net_arch: Sizes of their hidden layers.
        **common: See `IntrinsicReward`.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        learning_rate: float = 1e-3,
        net_arch: Sequence[int] = (256,),
        **common: Any,
    ) -> None:
        super().__init__(agent, **common)
        self.models = NextStateModels(agent.n_states, agent.n_actions, net_arch).to(agent.device)
        self.optimizer = torch.optim.Adam(self.models.parameters(), learning_rate)

    @torch.no_grad()
    def reward(self, observations: Tensors, actions: Tensor, next_observations: Tensors) -> Tensor:
        """Return KL(p(s'|s, a) || p(s'|a))."""
        states, actions, _ = self.vectors(observations, actions, next_observations)
        return self.models.divergence(states, actions).squeeze(1)

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return the negative log likelihood of both models."""
        return self.models.loss(states, actions, next_states)
