"""A small actor-critic to learn from: one actor, one critic, nothing else.

It is deep deterministic policy gradient (DDPG; Lillicrap et al., 2016, arXiv 1509.02971), in as few
lines as possible. The actor mu says what to do, the critic Q how good that is:

    explore  a = mu(s) + noise,  noise ~ N(0, ``exploration_noise``^2)
    critic   minimize E[(Q(s, a) - y)^2],  y = r + gamma (1 - d) Q'(s', mu'(s'))
    actor    maximize E[Q(s, mu(s))]
    targets  Q' and mu' follow Q and mu slowly: x' <- tau x + (1 - tau) x'
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor, nn

from scilab_rl.learning.nn import gradient_step, network, update_target
from scilab_rl.learning.off_policy import OffPolicyAlgorithm


class ACTOR_CRITIC(OffPolicyAlgorithm):
    """Deterministic actor and one critic.

    Args:
        learning_rate: Of actor and critic.
        learning_starts: Environment steps with random actions before the first update.
        exploration_noise: Standard deviation of the noise on actions scaled to [-1, 1].
        net_arch: Sizes of the hidden layers.
        **common: Batch size, gamma and so on, see `OffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)
    metrics = ("train/critic_loss", "train/actor_loss")

    def __init__(
        self,
        *,
        learning_rate: float = 1e-3,
        learning_starts: int = 1000,
        exploration_noise: float = 0.1,
        net_arch: Sequence[int] = (256, 256),
        **common: Any,
    ) -> None:
        super().__init__(learning_rate=learning_rate, learning_starts=learning_starts, **common)
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
        self.make_replay_buffer()

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1]."""
        actions = self.actor(observations)
        if deterministic:
            return actions
        noise = self.exploration_noise * torch.randn_like(actions)
        return (actions + noise).clamp(-1, 1)

    def action_values(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return Q(s, a). Shapes: ``(batch, 1)``."""
        return self.critic(torch.cat([observations, actions], dim=1))

    def update(self, batch: ReplayBufferSamples) -> dict[str, Tensor]:
        """Update critic, actor and targets, in this order."""
        with torch.no_grad():
            next_actions = self.actor_target(batch.next_observations)
            next_q = self.critic_target(torch.cat([batch.next_observations, next_actions], dim=1))
            targets = q_target(batch.rewards, batch.dones, next_q, self.gamma)
        q = self.action_values(batch.observations, batch.actions)
        critic_loss = gradient_step(self.critic_optimizer, (q - targets).square().mean())

        actions = self.actor(batch.observations)
        loss = -self.action_values(batch.observations, actions).mean()
        actor_loss = gradient_step(self.actor_optimizer, loss)

        update_target(self.critic_target, self.critic, self.tau)
        update_target(self.actor_target, self.actor, self.tau)
        return {"critic_loss": critic_loss, "actor_loss": actor_loss}


def q_target(rewards: Tensor, dones: Tensor, next_q: Tensor, gamma: float) -> Tensor:
    """Return y = r + gamma (1 - d) Q'(s', mu'(s')).

    Shapes:
        all tensors and the result: ``(batch, 1)``.
    """
    return rewards + gamma * (1 - dones) * next_q
