"""Twin delayed deep deterministic policy gradient (TD3) for sparse goals, compiled by JAX.

Fujimoto et al., 2018, "Addressing Function Approximation Error in Actor-Critic Methods", arXiv
1802.09477; with hindsight experience replay and the exploration of Andrychowicz et al., 2017,
arXiv 1707.01495, it is what first solved the Fetch tasks. An update takes a batch (s, a, r, s', d)
from the replay buffer and does, in this order:

    target   y = r + gamma (1 - d) min_i Q'_i(s', clip(pi'(s') + noise, -1, 1))        (eq. 14)
             with noise = clip(sigma eps, -c, c), clipped to the returns that there can be
    critics  J(Q_i) = E[(Q_i(s, a) - y)^2]                                        (algorithm 1)
    actor    J(pi) = -E[Q_1(s, pi(s))] + penalty E[|pi(s)|^2]      (algorithm 1; 1707.01495, A)
    targets  Q' and pi' follow by tau

All updates of a round are one compiled call, and while it computes, the environments take their
next steps; what else makes it fast, and the options for sparse rewards, are those of `jaxsac`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from gymnasium import spaces
from torch import Tensor

from scilab_rl.algorithms.intrinsic.build import make_intrinsic_reward
from scilab_rl.learning.jax_engine import Array, Batch, Params, State, forward
from scilab_rl.learning.jax_off_policy import (
    JaxOffPolicyAlgorithm,
    Losses,
    UpdateSettings,
    adam_step,
    bellman_targets,
    delayed,
    q_values,
    random_subset,
    squared_error,
    update_critics,
    update_targets,
)


@dataclass(frozen=True)
class Settings(UpdateSettings):
    """The constants of an update, for which it is compiled; see `JAXTD3`."""

    target_policy_noise: float
    target_noise_clip: float
    action_penalty: float


class JAXTD3(JaxOffPolicyAlgorithm):
    """Twin delayed deep deterministic policy gradient, compiled.

    Args:
        learning_rate: Of actor and critics.
        policy_delay: Critic updates per update of the actor.
        action_noise: Deviation of the normal noise on actions, as a share of half their range.
        target_policy_noise: Deviation of the noise on the target's actions; 0: none.
        target_noise_clip: Largest noise on the target's actions.
        action_penalty: Weight of the squared actions in the actor's loss.
        intrinsic: A reward that the agent gives itself, mixed into the environment's; see
            `scilab_rl.algorithms.intrinsic`. None: none.
        **common: Critics, batch size, gamma and so on, see `JaxOffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)

    def __init__(
        self,
        *,
        learning_rate: float = 1e-3,
        policy_delay: int = 2,
        action_noise: float = 0.1,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        action_penalty: float = 0.0,
        intrinsic: str | Mapping[str, object] | None = None,
        **common: Any,
    ) -> None:
        super().__init__(learning_rate=learning_rate, policy_delay=policy_delay, **common)
        self.action_noise = action_noise
        settings = Settings.of(
            self,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            action_penalty=action_penalty,
        )
        state = initial_state(*self.draw_networks(self.n_actions), learning_rate)
        self.start_learning(update, settings, state)
        self.intrinsic = make_intrinsic_reward(intrinsic, self)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1], with the networks of the last finished round."""
        vectors = self.normalizer(observations.numpy())
        actions = np.tanh(forward(self.rounds.networks["actor"], vectors, xp=np))
        if not deterministic:
            noise = self.action_noise * np.random.standard_normal(actions.shape)
            actions = np.clip(actions + noise, -1.0, 1.0)
        return torch.as_tensor(actions, dtype=torch.float32)


def initial_state(actor: Params, critic: Params, learning_rate: float) -> State:
    """Return weights and moments before the first update."""
    adam = optax.adam(learning_rate)
    return {
        "actor": actor,
        "actor_target": actor,
        "critic": critic,
        "critic_target": critic,
        "actor_optimizer": adam.init(actor),
        "critic_optimizer": adam.init(critic),
        "actor_loss": np.float32(0),  # of the last actor update: there are fewer of them
    }


def update(
    settings: Settings, state: State, batch: Batch, key: Array, index: Array
) -> tuple[State, Losses]:
    """Update critics, then actor, then target networks; see `UpdateRunner`."""
    targets, next_q = smoothed_targets(settings, state, batch, key)
    state, losses = update_critics(settings, state, batch, targets, next_q, squared_error)

    def update_actor(state: State) -> State:
        loss, gradient = jax.value_and_grad(actor_loss)(state["actor"], settings, state, batch)
        return adam_step(state, "actor", gradient, settings.learning_rate) | {"actor_loss": loss}

    state = delayed(settings, index, update_actor, state)
    losses["actor_loss"] = state["actor_loss"]
    return update_targets(state, ["actor", "critic"], settings.tau), losses


def smoothed_targets(
    settings: Settings, state: State, batch: Batch, key: Array
) -> tuple[Array, Array]:
    """Return y (eq. 14), clipped to possible returns, and the target critics' values.

    Shapes:
        y: ``(batch,)``; values: ``(n_critics, batch)``.
    """
    noise_key, subset_key = jax.random.split(key)
    actions = policy(state["actor_target"], batch.next_observations, settings.precision)
    if settings.target_policy_noise > 0:
        noise = settings.target_policy_noise * jax.random.normal(noise_key, actions.shape)
        noise = jnp.clip(noise, -settings.target_noise_clip, settings.target_noise_clip)
        actions = jnp.clip(actions + noise, -1, 1)
    next_q = q_values(state["critic_target"], batch.next_observations, actions, settings.precision)
    value = random_subset(next_q, settings.n_target_critics, subset_key).min(axis=0)
    return bellman_targets(settings, batch, value), next_q


def actor_loss(actor: Params, settings: Settings, state: State, batch: Batch) -> Array:
    """Return J(pi): minus the first critic's value, plus the penalty on large actions."""
    actions = policy(actor, batch.observations, settings.precision)
    first = jax.tree.map(lambda values: values[:1], state["critic"])
    q = q_values(first, batch.observations, actions, settings.precision)
    return settings.action_penalty * jnp.square(actions).mean() - q.mean()


def policy(actor: Params, observations: Array, precision: str) -> Array:
    """Return pi(s) in [-1, 1]. Shapes: ``(batch, n_actions)``."""
    return jnp.tanh(forward(actor, observations, precision=precision))
