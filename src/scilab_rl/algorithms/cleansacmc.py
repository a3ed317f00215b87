"""Soft actor-critic that is also rewarded for morphological computation; made from `cleansac`.

Morphological computation is what the body contributes to the next state beyond what the action
prescribes (Zahedi and Ay, 2013, "Quantifying Morphological Computation", Entropy 15, MC_W):

    MC(s, a) = KL(p(s'|s, a) || p(s'|a)),        r = r_e + eta MC(s, a),  eta = ``mc.reward_eta``.

Both models are networks that give a normal distribution with independent dimensions. They learn by
maximum likelihood from the same batches as the critics. A desired goal is not part of s'.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor, nn

from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.envs.types import Observation
from scilab_rl.learning.base import LazyNumber
from scilab_rl.learning.nn import GaussianNetwork, gradient_step
from scilab_rl.learning.observations import state_columns

LOG_STD_RANGE = (-5.0, 2.0)
# Weight eta of the intrinsic reward; learning rate and hidden layers of the two models.
MC_DEFAULTS = {"reward_eta": 0.01, "learning_rate": 1e-3, "net_arch": (256,)}


class NextStateModels(nn.Module):
    """Two models of the next state, which know the action; one of them also knows the state.

    Args:
        n_states: Length of a state.
        n_actions: Length of an action.
        net_arch: Sizes of the hidden layers of each.

    Shapes:
        states, next_states: ``(batch, n_states)``; actions: ``(batch, n_actions)``.
    """

    def __init__(self, n_states: int, n_actions: int, net_arch: Sequence[int]) -> None:
        super().__init__()
        self.state_action = GaussianNetwork(
            [n_states + n_actions, *net_arch, n_states], LOG_STD_RANGE
        )
        self.action = GaussianNetwork([n_actions, *net_arch, n_states], LOG_STD_RANGE)

    def divergence(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return MC(s, a). Shapes: ``(batch, 1)``."""
        informed = self.state_action(torch.cat([states, actions], dim=1))
        return gaussian_kl(*informed, *self.action(actions))

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return the sum of the negative log likelihoods. Shapes: scalar."""
        informed = self.state_action(torch.cat([states, actions], dim=1))
        blind = self.action(actions)
        return gaussian_nll(next_states, *informed) + gaussian_nll(next_states, *blind)


class CLEANSACMC(CLEANSAC):
    """Soft actor-critic with morphological computation as intrinsic reward.

    Args:
        mc: ``reward_eta``, weight of the intrinsic reward, and ``learning_rate`` and ``net_arch``
            of the two models; what is missing comes from ``MC_DEFAULTS``.
        **common: See `CLEANSAC`.
    """

    metrics = (  # type: ignore[assignment]
        "train/mc_model_loss",
        "train/morphological_computation",
        "train/rollout_mc_step",
    )

    def __init__(self, *, mc: Mapping[str, object] | None = None, **common: Any) -> None:
        super().__init__(**common)
        settings = complete_settings(mc)
        self.reward_eta = float(settings["reward_eta"])
        self.state_columns = state_columns(self.observation_space)
        sizes = (len(self.state_columns), self.n_actions, settings["net_arch"])
        self.models = NextStateModels(*sizes).to(self.device)
        self.model_optimizer = torch.optim.Adam(
            self.models.parameters(), settings["learning_rate"], fused=True
        )

    def update(self, batch: ReplayBufferSamples) -> dict[str, Tensor]:
        """Update the models, then what `CLEANSAC` updates."""
        loss = gradient_step(self.model_optimizer, self.model_loss(batch))
        return {"mc_model_loss": loss, **super().update(batch)}

    @torch.no_grad()
    def compute_targets(self, batch: ReplayBufferSamples) -> Tensor:
        """Return what the critics should say, y, with r in the place of r_e."""
        intrinsic = self.morphological_computation(batch.observations, batch.actions)
        self.logger.record("train/morphological_computation", intrinsic.mean())
        rewards = batch.rewards + self.reward_eta * intrinsic
        return super().compute_targets(batch._replace(rewards=rewards))

    def model_loss(self, batch: ReplayBufferSamples) -> Tensor:
        """Return the negative log likelihood of both models. Shapes: scalar."""
        states = batch.observations[:, self.state_columns]
        return self.models.loss(
            states, batch.actions, batch.next_observations[:, self.state_columns]
        )

    @torch.no_grad()
    def morphological_computation(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return MC(s, a). Shapes: ``(batch, 1)``."""
        return self.models.divergence(observations[:, self.state_columns], actions)

    def intrinsic_reward(
        self,
        observations: Observation,
        env_actions: np.ndarray,
        next_observations: Observation | None = None,
    ) -> Tensor:
        """Return MC(s, a) of a batch of steps, wherever they led. Shapes: ``(batch,)``."""
        actions = self.to_actions(env_actions)
        return self.morphological_computation(self.to_vector(observations), actions).squeeze(1)

    def record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record also MC(s, a) of the first environment's step."""
        super().record_step(observations, env_actions)
        mc = LazyNumber(lambda: self.intrinsic_reward(observations, env_actions)[0])
        self.logger.record("train/rollout_mc_step", mc)


def gaussian_nll(values: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the negative log likelihood of values under N(mean, std^2), averaged over the batch.

    Shapes:
        all tensors: ``(batch, n_states)``; result: scalar.
    """
    standardized = (values - mean) / log_std.exp()
    nll = 0.5 * standardized.square() + log_std + 0.5 * math.log(2 * math.pi)
    return nll.sum(dim=1).mean()


def gaussian_kl(mean_p: Tensor, log_std_p: Tensor, mean_q: Tensor, log_std_q: Tensor) -> Tensor:
    """Return KL(p || q) of normal distributions with independent dimensions.

    sum_j log(sigma_q / sigma_p) + (sigma_p^2 + (mu_p - mu_q)^2) / (2 sigma_q^2) - 1/2

    Shapes:
        all tensors: ``(batch, n_states)``; result: ``(batch, 1)``.
    """
    spread = ((2 * log_std_p).exp() + (mean_p - mean_q).square()) / (2 * (2 * log_std_q).exp())
    return (log_std_q - log_std_p + spread - 0.5).sum(dim=1, keepdim=True)


def complete_settings(mc: Mapping[str, object] | None) -> dict[str, Any]:
    """Return the settings of morphological computation with the defaults filled in."""
    unknown = set(mc or {}) - set(MC_DEFAULTS)
    if unknown:
        raise ValueError(f"mc has no {sorted(unknown)}; it has {', '.join(MC_DEFAULTS)}")
    return MC_DEFAULTS | dict(mc or {})
