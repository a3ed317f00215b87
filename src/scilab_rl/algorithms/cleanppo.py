"""Proximal policy optimization (PPO) in one file, for continuous and discrete actions.

Schulman et al., 2017, "Proximal Policy Optimization Algorithms", arXiv 1707.06347. The agent plays
``n_steps`` in each environment, then improves its policy on exactly these steps and forgets them:

    advantage  delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)              (eq. 12)
               A_t = delta_t + gamma lambda (1 - done_t) A_{t+1}                         (eq. 11)
    policy     L_clip = E[min(rho_t A_t, clip(rho_t, 1 - eps, 1 + eps) A_t)]             (eq. 7)
               rho_t = pi(a_t|s_t) / pi_old(a_t|s_t)
    value      L_vf = E[(V(s_t) - R_t)^2],  R_t = A_t + V(s_t)
    together   minimize -L_clip + c_1 L_vf - c_2 H(pi)                                   (eq. 9)

V(s_{t+1}) is the value of the state that the step really led to. An episode that was cut off
(truncated) therefore counts with the value of its last state, and one that terminated with nothing.

What differs from the paper: advantages are normalized per minibatch, gradients are clipped, and
``target_kl`` may end the epochs early, as in most implementations.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal

from scilab_rl.algorithms.intrinsic.build import make_intrinsic_reward
from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import VecStep
from scilab_rl.learning.base import LazyNumber, OneFileAlgorithm
from scilab_rl.learning.nn import gradient_step


class ActorCritic(nn.Module):
    """A policy and a value function, which share nothing.

    Args:
        n_observations: Length of an observation.
        n_actions: Number of discrete actions, or dimensions of a continuous one.
        net_arch: Sizes of the hidden layers of each.
        is_discrete: Kind of the actions.

    Shapes:
        observations: ``(batch, n_observations)``; values: ``(batch,)``;
        actions: ``(batch, n_actions)`` if continuous, ``(batch,)`` if discrete.
    """

    def __init__(
        self, n_observations: int, n_actions: int, net_arch: Sequence[int], is_discrete: bool
    ) -> None:
        super().__init__()
        # A nearly uniform first policy: small weights in the policy's last layer.
        self.actor = tanh_network([n_observations, *net_arch, n_actions], last_gain=0.01)
        self.critic = tanh_network([n_observations, *net_arch, 1], last_gain=1.0)
        self.log_std = None if is_discrete else nn.Parameter(torch.zeros(n_actions))

    def policy(self, observations: Tensor) -> Distribution:
        """Return the distribution of the actions."""
        output = self.actor(observations)
        if self.log_std is None:
            return Categorical(logits=output, validate_args=False)
        normal = Normal(output, self.log_std.exp().expand_as(output), validate_args=False)
        return Independent(normal, 1, validate_args=False)

    def value(self, observations: Tensor) -> Tensor:
        """Return the expected return."""
        return self.critic(observations).squeeze(-1)


class Rollout(NamedTuple):
    """The experience since the last update, of all environments one after the other.

    Shapes:
        observations: ``(n_steps * n_envs, n_observations)``; actions: ``(n_steps * n_envs, ...)``;
        all others: ``(n_steps * n_envs,)``.
    """

    observations: Tensor
    actions: Tensor
    log_probs: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor


class CLEANPPO(OneFileAlgorithm):
    """Proximal policy optimization.

    Args:
        env: Vector environment with continuous or discrete actions.
        learning_rate: Of policy and value function.
        n_steps: Steps of each environment per rollout.
        batch_size: Steps per gradient step.
        n_epochs: How often each step of a rollout is used.
        gamma: Discount factor.
        gae_lambda: Lambda of the advantage estimate: 0 trusts the value function, 1 the rewards.
        clip_range: How far, eps, the probability ratio may move.
        normalize_advantage: Whether advantages are standardised in each minibatch.
        ent_coef: Weight c_2 of the entropy.
        vf_coef: Weight c_1 of the value loss.
        max_grad_norm: Largest norm of a gradient.
        target_kl: Divergence from the old policy at which the epochs end; None: never.
        net_arch: Sizes of the hidden layers of policy and value function.
        intrinsic: A reward that the agent gives itself, mixed into the environment's; see
            `scilab_rl.algorithms.intrinsic`. None: none.
        seed, device: See `OneFileAlgorithm`.
    """

    supported_action_spaces = (spaces.Box, spaces.Discrete)
    metrics = (
        "train/policy_loss",
        "train/value_loss",
        "train/entropy",
        "train/approx_kl",
        "train/clip_fraction",
        "train/explained_variance",
        "train/n_updates",
        "train/rollout_value_step",
        "train/rollout_logpi_step",
    )

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float = 0.2,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        target_kl: float | None = None,
        net_arch: Sequence[int] = (64, 64),
        intrinsic: str | Mapping[str, object] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(env=env, seed=seed, device=device)
        self.learning_rate = learning_rate
        self.n_steps = n_steps
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.gamma = gamma
        self.gae_lambda = gae_lambda
        self.clip_range = clip_range
        self.normalize_advantage = normalize_advantage
        self.ent_coef = ent_coef
        self.vf_coef = vf_coef
        self.max_grad_norm = max_grad_norm
        self.target_kl = target_kl
        is_discrete = isinstance(self.action_space, spaces.Discrete)
        self.networks = ActorCritic(self.n_observations, self.n_actions, net_arch, is_discrete)
        self.networks.to(self.device)
        self.optimizer = torch.optim.Adam(
            self.networks.parameters(), learning_rate, eps=1e-5, fused=True
        )
        self.intrinsic = make_intrinsic_reward(intrinsic, self)

    def iterate(self, callback: BaseCallback) -> bool:
        """Collect a rollout, then learn from it."""
        rollout = self.collect(callback)
        if rollout is None:
            return False
        self.train(rollout)
        return True

    def collect(self, callback: BaseCallback) -> Rollout | None:
        """Play ``n_steps`` in each environment; return None if the callback stops."""
        callback.on_rollout_start()
        steps: list[VecStep] = []
        actions: list[Tensor] = []
        for _ in range(self.n_steps):
            with torch.no_grad():
                chosen = self.act(self.to_vector(self._last_obs), deterministic=False)
            env_actions = self.to_env_actions(chosen)
            self._record_step(self._last_obs, chosen)
            step = self.step(env_actions, callback)
            if step is None:
                return None
            steps.append(step)
            actions.append(chosen)
        callback.on_rollout_end()
        return self.make_rollout(steps, torch.stack(actions))

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions; continuous ones may lie outside [-1, 1] and are cut off there."""
        policy = self.networks.policy(observations)
        return policy.mode if deterministic else policy.sample()

    @torch.no_grad()
    def make_rollout(self, steps: Sequence[VecStep], actions: Tensor) -> Rollout:
        """Compute advantages and returns of consecutive steps.

        Shapes:
            actions: ``(n_steps, n_envs, ...)``.
        """
        observations = torch.stack([self.to_vector(step.observations) for step in steps])
        next_observations = torch.stack([self.to_vector(step.next_observations) for step in steps])
        rewards = self._stacked(steps, "rewards")
        if self.intrinsic is not None:
            rewards = self.intrinsic.mix(
                rewards.flatten(),
                observations.flatten(0, 1),
                actions.flatten(0, 1),
                next_observations.flatten(0, 1),
                batch_size=self.batch_size,
            ).view_as(rewards)
        values = self.networks.value(observations)
        advantages = generalized_advantages(
            rewards,
            values,
            self.networks.value(next_observations),
            self._stacked(steps, "terminated"),
            self._stacked(steps, "dones"),
            self.gamma,
            self.gae_lambda,
        )
        log_probs = self.networks.policy(observations).log_prob(actions)
        parts = (observations, actions, log_probs, values, advantages, advantages + values)
        return Rollout(*(part.flatten(0, 1) for part in parts))

    def train(self, rollout: Rollout) -> None:
        """Improve policy and value function in minibatches, ``n_epochs`` times over the rollout."""
        records: dict[str, list[Tensor]] = defaultdict(list)
        for indices in minibatches(len(rollout.actions), self.batch_size, self.n_epochs):
            batch = Rollout(*(part[indices.to(self.device)] for part in rollout))
            if not self._update(batch, records):
                break
        variance = explained_variance(rollout.values, rollout.returns)
        self.record_losses(records)
        self.logger.record("train/explained_variance", variance)
        self.logger.record("train/n_updates", self.n_updates)

    def _update(self, batch: Rollout, records: dict[str, list[Tensor]]) -> bool:
        """Take one gradient step; return False instead when the policy has moved too far."""
        policy = self.networks.policy(batch.observations)
        log_ratio = policy.log_prob(batch.actions) - batch.log_probs
        approx_kl = approximate_kl(log_ratio.detach())
        records["approx_kl"].append(approx_kl)
        if self.target_kl is not None and approx_kl > 1.5 * self.target_kl:
            return False

        advantages = batch.advantages
        if self.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        policy_loss = clipped_policy_loss(log_ratio, advantages, self.clip_range)
        value_loss = (self.networks.value(batch.observations) - batch.returns).square().mean()
        entropy = policy.entropy().mean()
        loss = policy_loss + self.vf_coef * value_loss - self.ent_coef * entropy

        gradient_step(self.optimizer, loss, self.max_grad_norm)
        self.n_updates += 1

        is_clipped = (log_ratio.detach().exp() - 1).abs() > self.clip_range
        records["policy_loss"].append(policy_loss.detach())
        records["value_loss"].append(value_loss.detach())
        records["entropy"].append(entropy.detach())
        records["clip_fraction"].append(is_clipped.float().mean())
        return True

    def _stacked(self, steps: Sequence[VecStep], name: str) -> Tensor:
        values = np.stack([getattr(step, name) for step in steps])
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)

    def _record_step(self, observations: Observation, actions: Tensor) -> None:
        """Record what the agent of the first environment thinks of its step."""
        value = LazyNumber(lambda: self.value(observations)[0])
        self.logger.record("train/rollout_value_step", value)
        self.logger.record(
            "train/rollout_logpi_step", LazyNumber(lambda: self._logpi(observations, actions))
        )

    @torch.no_grad()
    def _logpi(self, observations: Observation, actions: Tensor) -> Tensor:
        return self.networks.policy(self.to_vector(observations)).log_prob(actions)[0]

    @torch.no_grad()
    def value(self, observations: Observation) -> Tensor:
        """Return the expected return of a batch of observations. Shapes: ``(batch,)``."""
        return self.networks.value(self.to_vector(observations))

    @torch.no_grad()
    def entropy(self, observations: Observation) -> Tensor:
        """Return the entropy of the policy for a batch of observations. Shapes: ``(batch,)``."""
        return self.networks.policy(self.to_vector(observations)).entropy()


def tanh_network(sizes: Sequence[int], last_gain: float) -> nn.Sequential:
    """Return a network with orthogonal weights, whose last layer has its own gain."""
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        linear = nn.Linear(n_in, n_out)
        nn.init.orthogonal_(linear.weight, math.sqrt(2))
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.Tanh()]
    nn.init.orthogonal_(linear.weight, last_gain)
    return nn.Sequential(*layers[:-1])


def minibatches(n: int, batch_size: int, n_epochs: int) -> Iterator[Tensor]:
    """Yield the indices of each minibatch; in each epoch, each index comes once."""
    for _ in range(n_epochs):
        yield from torch.randperm(n).split(batch_size)


def generalized_advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    dones: Tensor,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Return the advantage of each step (eq. 11 and 12; Schulman et al., 2016, arXiv 1506.02438).

    Shapes:
        all tensors and the result: ``(n_steps, n_envs)``.
    """
    deltas = rewards + gamma * (1 - terminated) * next_values - values
    advantages = torch.zeros_like(deltas)
    following = torch.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        following = deltas[t] + gamma * gae_lambda * (1 - dones[t]) * following
        advantages[t] = following
    return advantages


def clipped_policy_loss(log_ratio: Tensor, advantages: Tensor, clip_range: float) -> Tensor:
    """Return -L_clip (eq. 7).

    Shapes:
        log_ratio: ``(batch,)``, log pi - log pi_old; advantages: ``(batch,)``; result: scalar.
    """
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    return -torch.min(ratio * advantages, clipped * advantages).mean()


def approximate_kl(log_ratio: Tensor) -> Tensor:
    """Return KL(pi_old || pi) from samples of pi_old: E[rho - 1 - log rho].

    The estimator k3 of J. Schulman, "Approximating KL Divergence" (2020), which is never negative.

    Shapes:
        log_ratio: ``(batch,)``; result: scalar.
    """
    return (log_ratio.exp() - 1 - log_ratio).mean()


def explained_variance(values: Tensor, returns: Tensor) -> Tensor:
    """Return how much of the returns the values predict: 1 all, 0 as little as a constant.

    Shapes:
        values, returns: ``(batch,)``; result: scalar, 0 where all returns are equal.
    """
    variance = returns.var()
    return torch.where(variance > 0, 1 - (returns - values).var() / variance, variance)
