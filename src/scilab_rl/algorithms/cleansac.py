"""Soft actor-critic (SAC), with optional hindsight experience replay (HER).

Haarnoja et al., 2018, "Soft Actor-Critic Algorithms and Applications", arXiv 1812.05905; HER:
Andrychowicz et al., 2017, arXiv 1707.01495. The agent maximizes reward plus entropy,
E[sum_t gamma^t (r_t + alpha H(pi(.|s_t)))]. An update takes a batch (s, a, r, s', d) from the
replay buffer and does, in this order:

    temperature  J(alpha) = E[-log alpha (log pi(a~|s) + H_target)]                       (eq. 18)
    target       y = r + gamma (1 - d) (min_i Q'_i(s', a') - alpha log pi(a'|s'))           (eq. 3)
    critics      J(Q_i) = E[1/2 (Q_i(s, a) - y)^2]                                          (eq. 5)
    actor        J(pi) = E[alpha log pi(a~|s) - min_i Q_i(s, a~)]                            (eq. 9)
    targets      Q'_i <- tau Q_i + (1 - tau) Q'_i

where a~ = tanh(mu(s) + sigma(s) eps) and a' are fresh actions of the policy.

What differs from the paper: any number of critics (``n_critics``), computed as one batched matrix
product; log alpha is learned instead of alpha, as in the authors' code.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor

from scilab_rl.algorithms.intrinsic.build import make_intrinsic_reward
from scilab_rl.envs.types import Observation
from scilab_rl.learning.base import LazyNumber
from scilab_rl.learning.nn import (
    Autocast,
    Critics,
    GaussianNetwork,
    autocast_to,
    critic_variance,
    gradient_step,
    update_target,
)
from scilab_rl.learning.off_policy import OffPolicyAlgorithm

LOG_STD_RANGE = (-20.0, 2.0)


class Actor(GaussianNetwork):
    """The policy: a normal distribution whose samples are squashed into [-scale, scale].

    Args:
        n_observations: Length of an observation.
        n_actions: Dimensions of an action.
        net_arch: Sizes of the hidden layers.
        scale: Largest action.
        autocast: Opens a context for the matrix products, see `autocast_to`.

    Shapes:
        observations: ``(batch, n_observations)``; actions: ``(batch, n_actions)``.
    """

    def __init__(
        self,
        n_observations: int,
        n_actions: int,
        net_arch: Sequence[int],
        scale: float,
        autocast: Autocast = nullcontext,
    ) -> None:
        super().__init__([n_observations, *net_arch, n_actions], LOG_STD_RANGE, autocast)
        self.scale = scale

    def sample(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Draw actions that gradients can flow through; return them and their log probabilities."""
        mean, log_std = self(observations)
        noise = torch.randn_like(mean)
        unsquashed = mean + log_std.exp() * noise
        log_prob = squashed_log_prob(noise, log_std, unsquashed, self.scale)
        return self.scale * torch.tanh(unsquashed), log_prob

    def log_prob(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return the log probability density of given actions."""
        mean, log_std = self(observations)
        unsquashed = torch.atanh((actions / self.scale).clamp(-1 + 1e-6, 1 - 1e-6))
        return squashed_log_prob(
            (unsquashed - mean) / log_std.exp(), log_std, unsquashed, self.scale
        )

    def mean_action(self, observations: Tensor) -> Tensor:
        """Return the squashed mean, the action that is taken without exploration."""
        return self.scale * torch.tanh(self(observations)[0])


class CLEANSAC(OffPolicyAlgorithm):
    """Soft actor-critic.

    Args:
        ent_coef: Weight alpha of the entropy: a number, ``auto`` (learned) or ``auto_0.1``
            (learned, from that initial value).
        target_entropy: Entropy that a learned alpha aims at; ``auto``: -n_actions.
        n_critics: Number of critics.
        ignore_dones_for_qvalue: Whether values continue beyond the end of an episode.
        action_scale_factor: Fraction of the action range that is used.
        log_obs_step: Whether each dimension of the observation is recorded at each step.
        log_act_step: The same for actions.
        net_arch: Sizes of the hidden layers of actor and critics.
        precision: ``float32`` or ``bfloat16``, of the matrix products.
        intrinsic: A reward that the agent gives itself, mixed into the environment's; see
            `scilab_rl.algorithms.intrinsic`. None: none.
        **common: Learning rate, batch size, gamma and so on, see `OffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)
    metrics = (
        "train/critic_loss",
        "train/actor_loss",
        "train/ent_coef",
        "train/rollout_logpi_step",
        ("train/ent_coef_loss", "ent_coef is auto", lambda self: self.learns_ent_coef),
        # Over the target critics.
        ("train/target_critic_variance", "n_critics is above 1", lambda self: self.n_critics > 1),
        ("train/rollout_obs_step_*", "log_obs_step is true", lambda self: self.log_obs_step),
        ("train/rollout_act_step_*", "log_act_step is true", lambda self: self.log_act_step),
    )

    def __init__(
        self,
        *,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        n_critics: int = 2,
        ignore_dones_for_qvalue: bool = False,
        action_scale_factor: float = 1.0,
        log_obs_step: bool = False,
        log_act_step: bool = False,
        net_arch: Sequence[int] = (256, 256),
        precision: str = "float32",
        intrinsic: str | Mapping[str, object] | None = None,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.n_critics = n_critics
        self.ignore_dones_for_qvalue = ignore_dones_for_qvalue
        self.action_scale_factor = action_scale_factor
        self.log_obs_step = log_obs_step
        self.log_act_step = log_act_step

        sizes = (self.n_observations, self.n_actions, net_arch)
        autocast = autocast_to(precision, self.device)
        self.actor = Actor(*sizes, action_scale_factor, autocast).to(self.device)
        self.critic = Critics(*sizes, n_critics, autocast).to(self.device)
        self.critic_target = copy.deepcopy(self.critic).requires_grad_(False)
        adam = partial(torch.optim.Adam, lr=self.learning_rate, fused=True)
        self.actor_optimizer = adam(self.actor.parameters())
        self.critic_optimizer = adam(self.critic.parameters())

        self.learns_ent_coef, initial = parse_ent_coef(ent_coef)
        self.ent_coef = torch.tensor(initial, device=self.device)
        self.target_entropy = -float(self.n_actions)
        if target_entropy != "auto":
            self.target_entropy = float(target_entropy)
        if self.learns_ent_coef:
            self.log_ent_coef = self.ent_coef.log().requires_grad_(True)
            self.ent_coef_optimizer = adam([self.log_ent_coef])

        self.make_replay_buffer()
        self.intrinsic = make_intrinsic_reward(intrinsic, self)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1]."""
        if deterministic:
            return self.actor.mean_action(observations)
        return self.actor.sample(observations)[0]

    def draw_random_actions(self) -> Tensor:
        """Draw an action for each environment from the range that is used."""
        return self.action_scale_factor * super().draw_random_actions()

    def action_values(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return what each critic thinks. Shapes: ``(batch, n_critics)``."""
        return self.critic(observations, actions)

    def update(self, batch: ReplayBufferSamples) -> dict[str, Tensor]:
        """Update temperature, critics, actor and target critics, in this order."""
        losses: dict[str, Tensor] = {}
        actions, log_prob = self.actor.sample(batch.observations)

        if self.learns_ent_coef:
            self.ent_coef = self.log_ent_coef.detach().exp()
            loss = temperature_loss(self.log_ent_coef, log_prob.detach(), self.target_entropy)
            losses["ent_coef_loss"] = gradient_step(self.ent_coef_optimizer, loss)

        targets = self.compute_targets(batch)
        loss = critic_loss(self.critic(batch.observations, batch.actions), targets)
        losses["critic_loss"] = gradient_step(self.critic_optimizer, loss)

        loss = actor_loss(log_prob, self.critic(batch.observations, actions), self.ent_coef)
        losses["actor_loss"] = gradient_step(self.actor_optimizer, loss)

        update_target(self.critic_target, self.critic, self.tau)
        self.logger.record("train/ent_coef", self.ent_coef)
        return losses

    @torch.no_grad()
    def compute_targets(self, batch: ReplayBufferSamples) -> Tensor:
        """Return what the critics should say, y. Shapes: ``(batch, 1)``."""
        next_actions, next_log_prob = self.actor.sample(batch.next_observations)
        next_q = self.critic_target(batch.next_observations, next_actions)
        if self.n_critics > 1:
            self.logger.record("train/target_critic_variance", critic_variance(next_q).mean())
        dones = torch.zeros_like(batch.dones) if self.ignore_dones_for_qvalue else batch.dones
        return soft_target(batch.rewards, dones, next_q, next_log_prob, self.ent_coef, self.gamma)

    def record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record what the agent of the first environment sees, does and thinks of it."""
        super().record_step(observations, env_actions)
        logpi = LazyNumber(lambda: self.log_prob(observations, env_actions)[0])
        self.logger.record("train/rollout_logpi_step", logpi)
        if self.log_obs_step:
            self.record_dimensions("train/rollout_obs_step", self.to_vector(observations)[0])
        if self.log_act_step:
            self.record_dimensions("train/rollout_act_step", env_actions[0])

    @torch.no_grad()
    def log_prob(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return the log density of actions scaled to [-1, 1]. Shapes: ``(batch,)``."""
        actions = self.to_actions(env_actions)
        return self.actor.log_prob(self.to_vector(observations), actions).squeeze(1)


def squashed_log_prob(noise: Tensor, log_std: Tensor, unsquashed: Tensor, scale: float) -> Tensor:
    """Return log pi(a|s) of a = scale tanh(u), u = mu + sigma eps (appendix C, eq. 26).

    log pi = sum_j log N(eps_j; 0, 1) - log sigma_j - log(scale (1 - tanh(u_j)^2)), with
    log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), which cannot overflow.

    Shapes:
        noise, log_std, unsquashed: ``(batch, n_actions)``; result: ``(batch, 1)``.
    """
    normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    squashing = 2 * (math.log(2) - unsquashed - F.softplus(-2 * unsquashed)) + math.log(scale)
    return (normal - squashing).sum(dim=-1, keepdim=True)


def temperature_loss(log_ent_coef: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """Return J(alpha) (eq. 18), with log alpha in the place of alpha.

    Shapes:
        log_prob: ``(batch, 1)``; result: scalar.
    """
    return -(log_ent_coef * (log_prob + target_entropy)).mean()


def soft_target(
    rewards: Tensor,
    dones: Tensor,
    next_q: Tensor,
    next_log_prob: Tensor,
    ent_coef: Tensor | float,
    gamma: float,
) -> Tensor:
    """Return y, the soft Bellman backup (eq. 3).

    Shapes:
        next_q: ``(batch, n_critics)``; all others and the result: ``(batch, 1)``.
    """
    next_value = next_q.amin(dim=1, keepdim=True) - ent_coef * next_log_prob
    return rewards + gamma * (1 - dones) * next_value


def critic_loss(q_values: Tensor, targets: Tensor) -> Tensor:
    """Return the sum of J(Q_i) over the critics (eq. 5).

    Shapes:
        q_values: ``(batch, n_critics)``; targets: ``(batch, 1)``; result: scalar.
    """
    return 0.5 * (q_values - targets).square().mean(dim=0).sum()


def actor_loss(log_prob: Tensor, q_values: Tensor, ent_coef: Tensor | float) -> Tensor:
    """Return J(pi) (eq. 9).

    Shapes:
        log_prob: ``(batch, 1)``; q_values: ``(batch, n_critics)``; result: scalar.
    """
    return (ent_coef * log_prob - q_values.amin(dim=1, keepdim=True)).mean()


def parse_ent_coef(ent_coef: str | float) -> tuple[bool, float]:
    """Return whether alpha is learned, and its initial or fixed value.

    >>> parse_ent_coef("auto"), parse_ent_coef("auto_0.1"), parse_ent_coef(0.2)
    ((True, 1.0), (True, 0.1), (False, 0.2))
    """
    word, _, initial = str(ent_coef).partition("_")
    learned = word == "auto"
    try:
        value = float(initial or 1.0) if learned else float(ent_coef)
    except ValueError:
        value = math.nan
    if not (value > 0 if learned else value >= 0):
        raise ValueError(f"ent_coef must be auto, auto_0.1 or a number, but it is {ent_coef!r}")
    return learned, value
