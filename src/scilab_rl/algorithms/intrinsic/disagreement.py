"""Disagreement: rewarded where several models of the world predict different things.

Pathak et al., 2019, "Self-Supervised Exploration via Disagreement", arXiv 1906.04161, eq. 1. An
ensemble of networks f_k predicts the next state; they differ in their initial weights only:

    r_i = E_k[ || f_k(s, a) - E_k[f_k(s, a)] ||^2 ],    loss = sum_k E[ || f_k(s, a) - s' ||^2 ].

What is random in the world is predicted by all models alike, as its mean, and so is not rewarded.
What differs from the paper: states are predicted themselves, not features of images.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from scilab_rl.algorithms.intrinsic.agents import Agent
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.learning.nn import Ensemble
from scilab_rl.learning.observations import Tensors


class Disagreement(IntrinsicReward):
    """The variance of an ensemble's predictions.

    Args:
        agent: The algorithm.
        learning_rate: Of the models.
        n_models: How many.
        net_arch: Sizes of their hidden layers.
        **common: See `IntrinsicReward`.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        learning_rate: float = 1e-3,
        n_models: int = 5,
        net_arch: Sequence[int] = (256,),
        **common: Any,
    ) -> None:
        super().__init__(agent, **common)
        sizes = [agent.n_states + agent.n_actions, *net_arch, agent.n_states]
        self.models = Ensemble(sizes, n_models).to(agent.device)
        self.optimizer = torch.optim.Adam(self.models.parameters(), learning_rate)

    @torch.no_grad()
    def reward(self, observations: Tensors, actions: Tensor, next_observations: Tensors) -> Tensor:
        """Return the variance over the models (eq. 1)."""
        states, actions, _ = self.vectors(observations, actions, next_observations)
        return ensemble_variance(self.models(states, actions))

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return the sum of the models' squared errors."""
        predictions = self.models(states, actions)
        return (predictions - next_states).square().sum(dim=2).mean(dim=1).sum()


def ensemble_variance(predictions: Tensor) -> Tensor:
    """Return the mean squared distance of the predictions from their mean.

    Shapes:
        predictions: ``(n_models, batch, n_states)``; result: ``(batch,)``.
    """
    return (predictions - predictions.mean(dim=0)).square().sum(dim=2).mean(dim=0)
