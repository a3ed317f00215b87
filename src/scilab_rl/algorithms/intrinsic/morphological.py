"""Morphological computation: rewarded for what the body does beyond what the action prescribes.

Zahedi and Ay, 2013, "Quantifying Morphological Computation", Entropy 15, MC_W; two networks that
give normal distributions learn by maximum likelihood:

    r_i = KL(p(s'|s, a) || p(s'|a)),    loss = E[-log p(s'|s, a) - log p(s'|a)].

The algorithm ``cleansacmc`` is the same idea written out in one file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from scilab_rl.algorithms.cleansacmc import NextStateModel, gaussian_kl, gaussian_nll
from scilab_rl.algorithms.intrinsic.agents import Agent, Batch
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward


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
        n_states, n_actions = agent.n_states, agent.n_actions
        self.state_action_model = NextStateModel(n_states + n_actions, n_states, net_arch)
        self.action_model = NextStateModel(n_actions, n_states, net_arch)
        models = nn.ModuleList([self.state_action_model, self.action_model]).to(agent.device)
        self.optimizer = torch.optim.Adam(models.parameters(), learning_rate)

    @torch.no_grad()
    def reward(self, observations: Batch, actions: Tensor, next_observations: Batch) -> Tensor:
        """Return KL(p(s'|s, a) || p(s'|a))."""
        states, actions, _ = self.vectors(observations, actions, next_observations)
        return gaussian_kl(*self._informed(states, actions), *self.action_model(actions)).squeeze(1)

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return the negative log likelihood of both models."""
        informed = gaussian_nll(next_states, *self._informed(states, actions))
        return informed + gaussian_nll(next_states, *self.action_model(actions))

    def _informed(self, states: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        return self.state_action_model(torch.cat([states, actions], dim=1))
