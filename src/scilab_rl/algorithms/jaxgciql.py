"""Goal-conditioned implicit Q-learning (GCIQL): learning from a data set alone, compiled by JAX.

Kostrikov et al., 2021, "Offline Reinforcement Learning with Implicit Q-Learning", arXiv 2110.06169,
with goals that are put in afterwards, as in OGBench (Park et al., 2024, arXiv 2410.20092). It
never acts to learn, so it cannot find out that an action which the data do not have is bad. Hence
no equation here asks the critics about such an action: V is what the better ones *of the data* lead
to, and the policy imitates the data, the better actions more.

    value    L(V)   = E[ |tau - 1(u < 0)| u^2 ],  u = min_i Q'_i(s, a, g) - V(s, g)         (eq. 5)
    critic   L(Q_i) = E[ (r + gamma (1 - d) V(s', g) - Q_i(s, a, g))^2 ]                    (eq. 6)
    actor    L(pi)  = E[ w |a - pi(s, g)|^2 ],  w = min(exp(beta u), 100)                   (eq. 7)

V is an expectile of Q over the actions of the data: their mean at tau = 0.5, their best at tau = 1.
Q' are the target networks. The policy is a Gaussian around pi(s, g) whose deviation is the same
everywhere, so that its log density is minus the squared distance; it acts by pi(s, g). At beta = 0
all weights are 1 and neither V nor Q matters: that is behavior cloning, with relabeled goals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from scilab_rl.envs.types import Observation
from scilab_rl.learning.jax_engine import Array, Batch, Params, State, dense_layers, forward
from scilab_rl.learning.jax_off_policy import (
    Losses,
    UpdateSettings,
    adam_step,
    bellman_targets,
    q_values,
    squared_error,
    update_critics,
    update_targets,
)
from scilab_rl.learning.jax_offline import JaxOfflineAlgorithm

_LARGEST_WEIGHT = 100.0


@dataclass(frozen=True)
class Settings(UpdateSettings):
    """The constants of an update, for which it is compiled; see `JAXGCIQL`."""

    expectile: float
    inverse_temperature: float


class JAXGCIQL(JaxOfflineAlgorithm):
    """Goal-conditioned implicit Q-learning, compiled.

    Args:
        env: Environment with goals, in which the agent is evaluated.
        data: What to learn from: ``scripted:1000``, ``random:1000``, ``run:RUN:1000`` or
            ``minari:ID``. A run reads it; the constructor does not.
        learning_rate: Of all networks.
        batch_size: Transitions per update.
        tau: How far the target critics move towards the critics in each update.
        gamma: Discount factor.
        train_freq: Updates per compiled call.
        expectile: Of the value, between 0 and 1.
        inverse_temperature: How much more better actions are imitated; 0: behavior cloning.
        n_critics: Number of critics.
        bounded_targets: Whether targets are clipped to what returns can be.
        normalize_observations: Whether the networks see observations of unit variance.
        layer_norm: Whether critics and value normalize their hidden layers.
        net_arch: Sizes of the hidden layers.
        precision: ``float32`` or ``bfloat16``, of the matrix products.
        replay_buffer_kwargs: How goals are put in, such as ``goal_selection_strategy``.
        seed, device: See `JaxOffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)
    metrics = (
        "train/value_loss",
        "train/advantage",  # of the data's actions, mean of u
        "train/advantage_weight",  # mean of w
    )

    def __init__(
        self,
        *,
        env: VecEnv,
        data: str | None = None,
        learning_rate: float = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.98,
        train_freq: int = 20,
        expectile: float = 0.9,
        inverse_temperature: float = 3.0,
        n_critics: int = 2,
        bounded_targets: bool = True,
        normalize_observations: bool = True,
        layer_norm: bool = False,
        net_arch: Sequence[int] = (256, 256),
        precision: str = "float32",
        replay_buffer_kwargs: dict[str, Any] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        kwargs = {"discount": gamma} | (replay_buffer_kwargs or {})
        super().__init__(
            env=env, learning_rate=learning_rate, batch_size=batch_size, tau=tau, gamma=gamma,
            train_freq=train_freq, n_critics=n_critics, bounded_targets=bounded_targets,
            normalize_observations=normalize_observations, layer_norm=layer_norm,
            net_arch=net_arch, precision=precision, replay_buffer_kwargs=kwargs,
            seed=seed, device=device,
        )  # fmt: skip
        self.data = data
        settings = Settings.of(self, expectile=expectile, inverse_temperature=inverse_temperature)
        actor, critic = self.draw_networks(self.n_actions)
        sizes = [self.n_observations, *self.net_arch, 1]
        value = dense_layers(sizes, layer_norm=layer_norm)
        state = initial_state(actor, critic, value, learning_rate)
        self.start_learning(update, settings, state, shown=("actor", "critic", "value"))

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Return pi(s, g) in [-1, 1], with the networks of the last finished round."""
        vectors = self.normalizer(observations.numpy())
        actions = np.tanh(forward(self.rounds.networks["actor"], vectors, xp=np))
        return torch.as_tensor(actions, dtype=torch.float32)

    def value(self, observations: Observation) -> np.ndarray:
        """Return V(s, g). Shapes: ``(batch,)``."""
        vectors = self.normalizer(self.to_vector(observations).numpy())
        return np.asarray(forward(self.rounds.networks["value"], vectors, xp=np)[:, 0])


def initial_state(actor: Params, critic: Params, value: Params, learning_rate: float) -> State:
    """Return weights and moments before the first update."""
    learned = {"actor": actor, "critic": critic, "value": value}
    adam = optax.adam(learning_rate)
    moments = {f"{name}_optimizer": adam.init(network) for name, network in learned.items()}
    return learned | moments | {"critic_target": critic}


def update(
    settings: Settings, state: State, batch: Batch, key: Array, index: Array
) -> tuple[State, Losses]:
    """Update value, actor, critics and target critics; see `UpdateRunner`. Nothing is random."""
    target_q = q_values(
        state["critic_target"], batch.observations, batch.actions, settings.precision
    )
    q = target_q.min(axis=0)
    loss, gradient = jax.value_and_grad(value_loss)(state["value"], settings, batch, q)
    state = adam_step(state, "value", gradient, settings.learning_rate)
    losses = {"value_loss": loss}

    advantages = q - values(state["value"], batch.observations, settings.precision)
    weights = advantage_weights(advantages, settings.inverse_temperature)
    loss, gradient = jax.value_and_grad(actor_loss)(state["actor"], settings, batch, weights)
    state = adam_step(state, "actor", gradient, settings.learning_rate)
    losses |= {
        "actor_loss": loss,
        "advantage": advantages.mean(),
        "advantage_weight": weights.mean(),
    }

    next_values = values(state["value"], batch.next_observations, settings.precision)
    targets = bellman_targets(settings, batch, next_values)
    state, critic_losses = update_critics(settings, state, batch, targets, target_q, squared_error)
    return update_targets(state, ["critic"], settings.tau), losses | critic_losses


def value_loss(value: Params, settings: Settings, batch: Batch, q: Array) -> Array:
    """Return L(V) (eq. 5). Shapes: q: ``(batch,)``."""
    differences = q - values(value, batch.observations, settings.precision)
    return expectile_loss(differences, settings.expectile).mean()


def expectile_loss(differences: Array, expectile: float) -> Array:
    """Return |tau - 1(u < 0)| u^2 of each difference u (eq. 4)."""
    return jnp.where(differences < 0, 1 - expectile, expectile) * jnp.square(differences)


def advantage_weights(advantages: Array, inverse_temperature: float) -> Array:
    """Return exp(beta u), at most 100, of each advantage u."""
    return jnp.minimum(jnp.exp(inverse_temperature * advantages), _LARGEST_WEIGHT)


def actor_loss(actor: Params, settings: Settings, batch: Batch, weights: Array) -> Array:
    """Return L(pi) (eq. 7). Shapes: weights: ``(batch,)``."""
    actions = jnp.tanh(forward(actor, batch.observations, precision=settings.precision))
    return (weights * jnp.square(actions - batch.actions).sum(axis=-1)).mean()


def values(value: Params, observations: Array, precision: str) -> Array:
    """Return V(s, g). Shapes: ``(batch,)``."""
    return forward(value, observations, precision=precision)[:, 0]
