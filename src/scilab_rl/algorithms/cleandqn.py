"""Deep Q-network (DQN), with optional hindsight experience replay (HER).

Mnih et al., 2015, "Human-level control through deep reinforcement learning", Nature 518; first as
arXiv 1312.5602. The agent takes the action of the highest value, and a random one with probability
epsilon. An update takes a batch (s, a, r, s', d) from the replay buffer:

    target   y = r + gamma (1 - d) max_a' Q'(s', a')
    loss     L = E[loss(y - Q(s, a))], Huber's or the squared error
    network  Q' <- tau Q + (1 - tau) Q'  every ``target_update_interval`` environment steps

What differs from the paper: Adam instead of RMSProp, vectors instead of stacked images.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor

from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import VecStep
from scilab_rl.learning.nn import gradient_step, network, update_target
from scilab_rl.learning.off_policy import OffPolicyAlgorithm


class CLEANDQN(OffPolicyAlgorithm):
    """Deep Q-network.

    Args:
        learning_rate: Of the Q-network.
        batch_size: Transitions per update.
        tau: How far the target network moves when it is updated; 1 copies.
        train_freq: Steps of each environment between rounds of updates.
        target_update_interval: Environment steps between updates of the target network.
        exploration_fraction: Fraction of the training in which epsilon falls to its final value.
        exploration_initial_eps: First epsilon.
        exploration_final_eps: Last epsilon.
        loss: ``huber`` or ``mse``.
        max_grad_norm: Largest norm of a gradient.
        net_arch: Sizes of the hidden layers.
        **common: Gamma, buffer size and so on, see `OffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Discrete,)
    metrics = ("train/loss", "train/q_mean", "train/exploration_rate")

    def __init__(
        self,
        *,
        learning_rate: float = 1e-4,
        batch_size: int = 32,
        tau: float = 1.0,
        train_freq: int = 4,
        target_update_interval: int = 10_000,
        exploration_fraction: float = 0.1,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        loss: str = "huber",
        max_grad_norm: float = 10.0,
        net_arch: Sequence[int] = (64, 64),
        **common: Any,
    ) -> None:
        super().__init__(
            learning_rate=learning_rate,
            batch_size=batch_size,
            tau=tau,
            train_freq=train_freq,
            **common,
        )
        if loss not in LOSSES:
            raise ValueError(f"loss must be one of {', '.join(LOSSES)}, but it is {loss!r}")
        self.target_update_interval = target_update_interval
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.loss = loss
        self.max_grad_norm = max_grad_norm

        sizes = [self.n_observations, *net_arch, self.n_actions]
        self.q_network = network(sizes).to(self.device)
        self.target_network = copy.deepcopy(self.q_network).requires_grad_(False)
        self.optimizer = torch.optim.Adam(self.q_network.parameters(), learning_rate, fused=True)
        self.make_replay_buffer()

    def store(self, step: VecStep, actions: np.ndarray) -> None:
        """Add a step to the replay buffer; update the target network when it is time."""
        super().store(step, actions)
        if self.num_timesteps % self.target_update_interval < self.n_envs:
            update_target(self.target_network, self.q_network, self.tau)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose the best actions, each replaced by a random one with probability epsilon."""
        best = self.q_network(observations).argmax(dim=1)
        if deterministic:
            return best
        random_actions = torch.randint_like(best, self.n_actions)
        is_random = torch.rand(len(best), device=best.device) < self.exploration_rate
        return torch.where(is_random, random_actions, best)

    @property
    def exploration_rate(self) -> float:
        """The present epsilon."""
        return linear_schedule(
            self.num_timesteps / max(self._total_timesteps, 1),
            self.exploration_fraction,
            self.exploration_initial_eps,
            self.exploration_final_eps,
        )

    def update(self, batch: ReplayBufferSamples) -> dict[str, Tensor]:
        """Update the Q-network."""
        with torch.no_grad():
            next_q = self.target_network(batch.next_observations)
            targets = q_target(batch.rewards, batch.dones, next_q, self.gamma)
        q = self.action_values(batch.observations, batch.actions)
        loss = gradient_step(self.optimizer, LOSSES[self.loss](q, targets), self.max_grad_norm)
        self.logger.record("train/exploration_rate", self.exploration_rate)
        return {"loss": loss, "q_mean": q.detach().mean()}

    def action_values(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return the values of actions. Shapes: ``(batch, 1)``."""
        return self.q_network(observations).gather(1, actions.long())

    @torch.no_grad()
    def value(self, observations: Observation) -> Tensor:
        """Return the value of the best action. Shapes: ``(batch,)``."""
        return self.q_network(self.to_vector(observations)).amax(dim=1)


LOSSES = {"huber": F.smooth_l1_loss, "mse": F.mse_loss}


def q_target(rewards: Tensor, dones: Tensor, next_q: Tensor, gamma: float) -> Tensor:
    """Return y = r + gamma (1 - d) max_a' Q'(s', a').

    Shapes:
        rewards, dones, result: ``(batch, 1)``; next_q: ``(batch, n_actions)``.
    """
    return rewards + gamma * (1 - dones) * next_q.amax(dim=1, keepdim=True)


def linear_schedule(progress: float, fraction: float, initial: float, final: float) -> float:
    """Return a value that moves from initial to final in the first fraction of the training.

    >>> linear_schedule(0.05, fraction=0.1, initial=1.0, final=0.0)
    0.5
    """
    if progress >= fraction:
        return final
    return initial + (final - initial) * progress / fraction
