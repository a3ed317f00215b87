"""Intrinsic curiosity module (ICM): rewarded for consequences that could not be predicted.

Pathak et al., 2017, "Curiosity-driven Exploration by Self-supervised Prediction", arXiv 1705.05363.
Features phi of the state are learned so that the action can be inferred from them, and so leave out
what the agent has no influence on:

    inverse model   a^ = g(phi(s), phi(s')),      L_I = error of a^                     (eq. 2, 3)
    forward model   phi^(s') = f(phi(s), a),      L_F = 1/2 || phi^(s') - phi(s') ||^2  (eq. 4, 5)
    reward          r_i = 1/2 || phi^(s') - phi(s') ||^2                                (eq. 6)
    together        minimise (1 - beta) L_I + beta L_F                                  (eq. 7)

L_I is the squared error of continuous actions and the cross entropy of discrete ones. What differs
from the paper: eta of eq. 6 is ``weight`` here, and lambda of eq. 7 is 1, since the policy learns
with an optimizer of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scilab_rl.algorithms.intrinsic.agents import Agent
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.learning.nn import network
from scilab_rl.learning.observations import Tensors


class IntrinsicCuriosityModule(IntrinsicReward):
    """The error in predicting the features of the next state.

    Args:
        agent: The algorithm.
        learning_rate: Of all three networks.
        beta: Weight of the forward model's loss against the inverse model's, from 0 to 1.
        n_features: Length of phi.
        net_arch: Sizes of the hidden layers of each network.
        **common: See `IntrinsicReward`.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        learning_rate: float = 1e-3,
        beta: float = 0.2,
        n_features: int = 32,
        net_arch: Sequence[int] = (256,),
        **common: Any,
    ) -> None:
        super().__init__(agent, **common)
        self.beta = beta
        self.features = network([agent.n_states, *net_arch, n_features])
        self.inverse_model = network([2 * n_features, *net_arch, agent.n_actions])
        self.forward_model = network([n_features + agent.n_actions, *net_arch, n_features])
        networks = nn.ModuleList([self.features, self.inverse_model, self.forward_model])
        self.optimizer = torch.optim.Adam(networks.to(agent.device).parameters(), learning_rate)

    @torch.no_grad()
    def reward(self, observations: Tensors, actions: Tensor, next_observations: Tensors) -> Tensor:
        """Return 1/2 || phi^(s') - phi(s') ||^2 (eq. 6)."""
        states, actions, next_states = self.vectors(observations, actions, next_observations)
        return self._forward_error(self.features(states), actions, self.features(next_states))

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return (1 - beta) L_I + beta L_F (eq. 7)."""
        phi, next_phi = self.features(states), self.features(next_states)
        guessed = self.inverse_model(torch.cat([phi, next_phi], dim=1))
        inverse = inverse_error(guessed, actions, self.agent.has_discrete_actions).mean()
        forward = self._forward_error(phi, actions, next_phi).mean()
        return (1 - self.beta) * inverse + self.beta * forward

    def _forward_error(self, phi: Tensor, actions: Tensor, next_phi: Tensor) -> Tensor:
        return forward_error(self.forward_model(torch.cat([phi, actions], dim=1)), next_phi)


def forward_error(predicted: Tensor, features: Tensor) -> Tensor:
    """Return 1/2 || phi^ - phi ||^2 (eq. 5). Shapes: ``(batch, n)`` twice to ``(batch,)``."""
    return 0.5 * (predicted - features).square().sum(dim=1)


def inverse_error(guessed: Tensor, actions: Tensor, is_discrete: bool) -> Tensor:
    """Return the error of guessed actions (eq. 3).

    Shapes:
        guessed: ``(batch, n_actions)``, logits of discrete ones; actions: ``(batch, n_actions)``,
        one-hot if discrete; result: ``(batch,)``.
    """
    if is_discrete:
        return F.cross_entropy(guessed, actions, reduction="none")
    return (guessed - actions).square().sum(dim=1)
