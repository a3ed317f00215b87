"""One-step actor-critic in one file: learns after each single step, and remembers nothing.

Sutton and Barto, 2018, "Reinforcement Learning: An Introduction", second edition, section 13.5,
"One-step Actor-Critic (episodic)". After each step from S by action A to S' with reward R:

    delta <- R + gamma v(S', w) - v(S, w)        (v(S', w) = 0 if S' is terminal)
    w     <- w + alpha_w delta grad v(S, w)
    theta <- theta + alpha_theta I delta grad log pi(A|S, theta)
    I     <- gamma I                             (I = 1 at the start of an episode)

What differs from the book: the two functions are neural networks; Adam scales the steps alpha_w
and alpha_theta; the mean over several environments is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.distributions import Categorical

from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import VecStep
from scilab_rl.learning.base import LazyNumber, OneFileAlgorithm
from scilab_rl.learning.nn import gradient_step, network


class ONESTEPAC(OneFileAlgorithm):
    """One-step actor-critic for discrete actions.

    Args:
        env: Vector environment with discrete actions.
        learning_rate: Step size alpha_theta of the policy.
        critic_learning_rate: Step size alpha_w of the value function.
        gamma: Discount factor.
        discount_updates: Whether the policy's steps shrink with I during an episode, as in the
            book; without, late steps count as much as early ones.
        net_arch: Sizes of the hidden layers of policy and value function.
        seed, device: See `OneFileAlgorithm`.
    """

    supported_action_spaces = (spaces.Discrete,)
    metrics = (
        "train/td_error",
        "train/actor_loss",
        "train/critic_loss",
        "train/entropy",
        "train/rollout_value_step",
    )

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 1e-4,
        critic_learning_rate: float = 5e-4,
        gamma: float = 0.99,
        discount_updates: bool = True,
        net_arch: Sequence[int] = (64, 64),
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(env=env, seed=seed, device=device)
        self.learning_rate = learning_rate
        self.gamma = gamma
        self.discount_updates = discount_updates
        sizes = [self.n_observations, *net_arch]
        self.actor = network([*sizes, self.n_actions], nn.Tanh).to(self.device)
        self.critic = network([*sizes, 1], nn.Tanh).to(self.device)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), learning_rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(
            self.critic.parameters(), critic_learning_rate, fused=True
        )
        # I of the running episode of each environment.
        self.discounts = torch.ones(self.n_envs, device=self.device)

    def iterate(self, callback: BaseCallback) -> bool:
        """Take one step in each environment and learn from it."""
        callback.on_rollout_start()
        observations = self._last_obs
        with torch.no_grad():
            actions = self.act(self.to_vector(observations), deterministic=False)
        self.logger.record(
            "train/rollout_value_step", LazyNumber(lambda: self.value(observations)[0])
        )
        step = self.step(self.to_env_actions(actions), callback)
        if step is None:
            return False
        callback.on_rollout_end()
        self.train(step, actions)
        return True

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions, counted from 0."""
        policy = self.policy(observations)
        return policy.mode if deterministic else policy.sample()

    def policy(self, observations: Tensor) -> Categorical:
        """Return pi(.|S). Shapes: ``(batch, n_observations)``."""
        return Categorical(logits=self.actor(observations), validate_args=False)

    def train(self, step: VecStep, actions: Tensor) -> None:
        """Update value function and policy once."""
        observations = self.to_vector(step.observations)
        policy = self.policy(observations)
        with torch.no_grad():
            next_values = self.critic(self.to_vector(step.next_observations)).squeeze(1)
            targets = td_target(
                self._tensor(step.rewards), self._tensor(step.terminated), next_values, self.gamma
            )
        delta = targets - self.critic(observations).squeeze(1)
        critic_loss = 0.5 * delta.square().mean()
        discounts = self.discounts if self.discount_updates else torch.ones_like(self.discounts)
        actor_loss = -(discounts * delta.detach() * policy.log_prob(actions)).mean()
        losses = {
            "critic_loss": [gradient_step(self.critic_optimizer, critic_loss)],
            "actor_loss": [gradient_step(self.actor_optimizer, actor_loss)],
        }

        ended = torch.as_tensor(step.dones, device=self.device)
        self.discounts = torch.where(ended, 1.0, self.gamma * self.discounts)
        self.n_updates += 1
        self.record_losses(losses)
        self.logger.record("train/td_error", delta.detach().mean())
        self.logger.record("train/entropy", LazyNumber(lambda: policy.entropy().mean()))

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)

    @torch.no_grad()
    def value(self, observations: Observation) -> Tensor:
        """Return v(S) for a batch of observations. Shapes: ``(batch,)``."""
        return self.critic(self.to_vector(observations)).squeeze(1)


def td_target(rewards: Tensor, terminated: Tensor, next_values: Tensor, gamma: float) -> Tensor:
    """Return R + gamma v(S'), or R alone where S' is terminal.

    Shapes:
        all tensors and the result: ``(batch,)``.
    """
    return rewards + gamma * (1 - terminated) * next_values
