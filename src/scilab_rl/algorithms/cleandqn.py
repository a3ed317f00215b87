"""Deep Q-network (DQN) in one file, with optional hindsight experience replay (HER).

Mnih et al., 2015, "Human-level control through deep reinforcement learning", Nature 518; first as
arXiv 1312.5602. The agent takes the action of the highest value, and a random one with probability
epsilon. An update takes a batch (s, a, r, s', d) from the replay buffer:

    target   y = r + gamma (1 - d) max_a' Q'(s', a')
    loss     L = E[loss(y - Q(s, a))], Huber's or the squared error
    network  Q' <- tau Q + (1 - tau) Q'  every ``target_update_interval`` environment steps

What differs from the paper: Adam instead of RMSProp, vectors instead of stacked images.

Metrics: train/loss, train/exploration_rate, train/q_mean, and per environment step
train/rollout_q_step.
"""

from __future__ import annotations

import copy
import itertools
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from scilab_rl.algorithms.base import LazyNumber, Observation, OneFileAlgorithm


class CLEANDQN(OneFileAlgorithm):
    """Deep Q-network.

    Args:
        env: Vector environment with discrete actions.
        learning_rate: Of the Q-network.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Transitions per update.
        tau: How far the target network follows when it is updated; 1 copies.
        gamma: Discount factor.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        target_update_interval: Environment steps between updates of the target network.
        exploration_fraction: Fraction of the training in which epsilon falls to its final value.
        exploration_initial_eps: First epsilon.
        exploration_final_eps: Last epsilon.
        loss: ``huber`` or ``mse``.
        max_grad_norm: Largest norm of a gradient.
        net_arch: Sizes of the hidden layers.
        replay_buffer_class: None: a plain replay buffer.
        replay_buffer_kwargs: Further arguments of the replay buffer.
        seed, device: See `OneFileAlgorithm`.
    """

    supported_action_spaces = (spaces.Discrete,)

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 1e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 32,
        tau: float = 1.0,
        gamma: float = 0.99,
        train_freq: int = 4,
        gradient_steps: int = 1,
        target_update_interval: int = 10_000,
        exploration_fraction: float = 0.1,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        loss: str = "huber",
        max_grad_norm: float = 10.0,
        net_arch: Sequence[int] = (64, 64),
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(env=env, seed=seed, device=device)
        if loss not in LOSSES:
            raise ValueError(f"loss must be one of {', '.join(LOSSES)}, but it is {loss!r}")
        self.learning_rate = learning_rate
        self.learning_starts = learning_starts
        self.batch_size = batch_size
        self.tau = tau
        self.gamma = gamma
        self.train_freq = train_freq
        self.gradient_steps = gradient_steps
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
        self.replay_buffer = self.make_replay_buffer(
            buffer_size, replay_buffer_class, replay_buffer_kwargs
        )

    def iterate(self, callback: BaseCallback) -> bool:
        """Collect ``train_freq`` steps of each environment, then update."""
        if not self.collect(callback):
            return False
        if self.num_timesteps > self.learning_starts:
            as_collected = self.train_freq * self.n_envs
            self.train(self.gradient_steps if self.gradient_steps >= 0 else as_collected)
        return True

    def collect(self, callback: BaseCallback) -> bool:
        """Act and store what happens; return False when the callback wants to stop."""
        callback.on_rollout_start()
        for _ in range(self.train_freq):
            actions = self.explore()
            self._record_step(self._last_obs, actions)
            step = self.step(actions, callback)
            if step is None:
                return False
            self.store(step, self.from_env_actions(actions))
            if self.num_timesteps % self.target_update_interval < self.n_envs:
                follow(self.target_network, self.q_network, self.tau)
        callback.on_rollout_end()
        return True

    def explore(self) -> np.ndarray:
        """Choose the actions for the next step: random ones at first, then epsilon-greedy."""
        if self.num_timesteps < self.learning_starts:
            return self.sample_env_actions()
        with torch.no_grad():
            actions = self.act(self.to_vector(self._last_obs), deterministic=False)
        return self.to_env_actions(actions)

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

    def train(self, gradient_steps: int) -> None:
        """Update the Q-network."""
        records: dict[str, list[Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            batch = self.sample(self.batch_size)
            with torch.no_grad():
                next_q = self.target_network(batch.next_observations)
                targets = q_target(batch.rewards, batch.dones, next_q, self.gamma)
            q = self.q_network(batch.observations).gather(1, batch.actions.long())
            loss = LOSSES[self.loss](q, targets)

            self.optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.q_network.parameters(), self.max_grad_norm)
            self.optimizer.step()
            self.n_updates += 1
            records["loss"].append(loss.detach())
            records["q_mean"].append(q.detach().mean())
        self.record_losses(records)
        self.logger.record("train/exploration_rate", self.exploration_rate)

    def _record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        q = LazyNumber(lambda: self.q_values(observations, env_actions)[0])
        self.logger.record("train/rollout_q_step", q)

    @torch.no_grad()
    def q_values(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return the values of a batch of steps. Shapes: ``(batch, 1)``."""
        actions = torch.as_tensor(self.from_env_actions(env_actions), device=self.device)
        return self.q_network(self.to_vector(observations)).gather(1, actions.long())

    @torch.no_grad()
    def value(self, observations: Observation) -> Tensor:
        """Return the value of the best action. Shapes: ``(batch,)``."""
        return self.q_network(self.to_vector(observations)).amax(dim=1)


LOSSES = {"huber": F.smooth_l1_loss, "mse": F.mse_loss}


def network(sizes: Sequence[int]) -> nn.Sequential:
    """Return a network with rectified linear units between its layers."""
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


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


@torch.no_grad()
def follow(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move the target network a fraction tau towards the learned one."""
    for slow, fast in zip(target.parameters(), source.parameters(), strict=True):
        slow.lerp_(fast, tau)
