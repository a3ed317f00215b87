"""Rewarded for what the critics disagree about.

The Scilab-RL paper, section "Illustrative example": r_i = Var[Q_1(s, a), ..., Q_N(s, a)], the mean
squared deviation from the critics' mean, scaled to [0, 1] in each batch. High where the agent has
not been often enough for its critics to agree.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from scilab_rl.algorithms.intrinsic.agents import Agent
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.errors import ConfigError
from scilab_rl.learning.nn import critic_variance
from scilab_rl.learning.observations import Tensors


class CriticVariance(IntrinsicReward):
    """The variance of the critics; learns nothing of its own.

    Args:
        agent: The algorithm, with at least two critics.
        normalize: See `IntrinsicReward`.
        **common: See `IntrinsicReward`.
    """

    def __init__(self, agent: Agent, *, normalize: str = "min_max", **common: Any) -> None:
        super().__init__(agent, normalize=normalize, **common)
        if agent.n_critics < 2:
            raise ConfigError(
                "The intrinsic reward 'critic_variance' needs an algorithm with two critics or "
                f"more, but {type(agent.algorithm).__name__} has {agent.n_critics}. Set n_critics, "
                "or use disagreement, icm, morphological or rnd."
            )

    @torch.no_grad()
    def reward(self, observations: Tensors, actions: Tensor, next_observations: Tensors) -> Tensor:
        """Return Var_i[Q_i(s, a)]."""
        return critic_variance(self.agent.q_values(observations, actions)).squeeze(1)
