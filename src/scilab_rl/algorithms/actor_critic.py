"""A small actor-critic to learn from: one actor, one critic, nothing else.

It is deep deterministic policy gradient (DDPG; Lillicrap et al., 2016, arXiv 1509.02971), in as few
lines as possible. The actor mu says what to do, the critic Q how good that is:

    explore  a = mu(s) + noise,  noise ~ N(0, ``exploration_noise``^2)
    critic   minimise E[(Q(s, a) - y)^2],  y = r + gamma (1 - d) Q'(s', mu'(s'))
    actor    maximise E[Q(s, mu(s))]
    targets  Q' and mu' follow Q and mu slowly: x' <- tau x + (1 - tau) x'

Metrics: train/critic_loss, train/actor_loss, and per environment step train/rollout_q_step.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from scilab_rl.algorithms.base import LazyNumber, Observation, OneFileAlgorithm


class ACTOR_CRITIC(OneFileAlgorithm):
    """Deterministic actor and one critic.

    Args:
        env: Vector environment with continuous actions.
        learning_rate: Of actor and critic.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Transitions per update.
        tau: How far the targets follow in each update.
        gamma: Discount factor.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        exploration_noise: Standard deviation of the noise on actions scaled to [-1, 1].
        net_arch: Sizes of the hidden layers.
        replay_buffer_class: None: a plain replay buffer.
        replay_buffer_kwargs: Further arguments of the replay buffer.
        seed, device: See `OneFileAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 1000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int = 1,
        gradient_steps: int = 1,
        exploration_noise: float = 0.1,
        net_arch: Sequence[int] = (256, 256),
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(env=env, seed=seed, device=device)
        self.learning_rate = learning_rate
        self.learning_starts = learning_starts
        self.batch_size = batch_size
        self.tau = tau
        self.gamma = gamma
        self.train_freq = train_freq
        self.gradient_steps = gradient_steps
        self.exploration_noise = exploration_noise

        n_in, n_out = self.n_observations, self.n_actions
        self.actor = nn.Sequential(network([n_in, *net_arch, n_out]), nn.Tanh()).to(self.device)
        self.critic = network([n_in + n_out, *net_arch, 1]).to(self.device)
        self.actor_target = copy.deepcopy(self.actor).requires_grad_(False)
        self.critic_target = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), learning_rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(
            self.critic.parameters(), learning_rate, fused=True
        )
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
            env_actions = self.to_env_actions(actions)
            self._record_step(self._last_obs, env_actions)
            step = self.step(env_actions, callback)
            if step is None:
                return False
            self.store(step, actions.cpu().numpy())
        callback.on_rollout_end()
        return True

    def explore(self) -> Tensor:
        """Choose the actions for the next step: random ones at first, then the actor's."""
        if self.num_timesteps < self.learning_starts:
            return torch.as_tensor(self.from_env_actions(self.sample_env_actions()))
        with torch.no_grad():
            return self.act(self.to_vector(self._last_obs), deterministic=False)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1]."""
        actions = self.actor(observations)
        if deterministic:
            return actions
        noise = self.exploration_noise * torch.randn_like(actions)
        return (actions + noise).clamp(-1, 1)

    def train(self, gradient_steps: int) -> None:
        """Update critic, actor and targets, in this order."""
        critic_losses, actor_losses = [], []
        for _ in range(gradient_steps):
            batch = self.sample(self.batch_size)

            with torch.no_grad():
                next_actions = self.actor_target(batch.next_observations)
                next_q = q_value(self.critic_target, batch.next_observations, next_actions)
                targets = q_target(batch.rewards, batch.dones, next_q, self.gamma)
            q = q_value(self.critic, batch.observations, batch.actions)
            critic_loss = (q - targets).square().mean()
            critic_losses.append(descend(self.critic_optimizer, critic_loss))

            actions = self.actor(batch.observations)
            actor_loss = -q_value(self.critic, batch.observations, actions).mean()
            actor_losses.append(descend(self.actor_optimizer, actor_loss))

            follow(self.critic_target, self.critic, self.tau)
            follow(self.actor_target, self.actor, self.tau)
            self.n_updates += 1
        self.record_losses({"critic_loss": critic_losses, "actor_loss": actor_losses})

    def _record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        q = LazyNumber(lambda: self.q_values(observations, env_actions)[0])
        self.logger.record("train/rollout_q_step", q)

    @torch.no_grad()
    def q_values(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return what the critic thinks of a batch of steps. Shapes: ``(batch, 1)``."""
        actions = torch.as_tensor(self.from_env_actions(env_actions), device=self.device)
        return q_value(self.critic, self.to_vector(observations), actions)


def network(sizes: Sequence[int]) -> nn.Sequential:
    """Return a network with rectified linear units between its layers."""
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def q_value(critic: nn.Module, observations: Tensor, actions: Tensor) -> Tensor:
    """Return Q(s, a). Shapes: ``(batch, 1)``."""
    return critic(torch.cat([observations, actions], dim=1))


def q_target(rewards: Tensor, dones: Tensor, next_q: Tensor, gamma: float) -> Tensor:
    """Return y = r + gamma (1 - d) Q'(s', mu'(s')).

    Shapes:
        all tensors and the result: ``(batch, 1)``.
    """
    return rewards + gamma * (1 - dones) * next_q


def descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> Tensor:
    """Take one step down the gradient, of the optimizer's own parameters only; return the loss."""
    optimizer.zero_grad()
    loss.backward(inputs=[p for group in optimizer.param_groups for p in group["params"]])
    optimizer.step()
    return loss.detach()


@torch.no_grad()
def follow(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move the target network a fraction tau towards the learned one."""
    for slow, fast in zip(target.parameters(), source.parameters(), strict=True):
        slow.lerp_(fast, tau)
