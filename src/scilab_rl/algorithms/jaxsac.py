"""Soft actor-critic (SAC) for sparse goals, fast: compiled by JAX, learning while it acts.

The update is that of `cleansac`, equation by equation: Haarnoja et al., 2018, "Soft Actor-Critic
Algorithms and Applications", arXiv 1812.05905. What differs:

* All updates of a round are one compiled call (`jax.lax.scan`), and while it computes, the
  environments take their next steps (``overlap``). The data that an update may see are the same;
  the policy that acts is the one from before the round that is being computed. A run is
  reproducible to the bit either way.
* Options that make sparse rewards learnable with fewer steps. Each is off by default:

    bounded_targets   y is clipped to what a discounted return can be: with rewards in [l, h],
                      y in [l / (1 - gamma), h / (1 - gamma)]. Stops the overestimation that far
                      goals invite (Andrychowicz et al., 2017, arXiv 1707.01495, appendix A; Luo et
                      al., 2023, arXiv 2312.05787, section 4).
    backup_entropy    whether y rewards entropy (eq. 3). What it adds, up to alpha * entropy /
                      (1 - gamma), lies outside of that interval, and is clipped as well.
    random_actions    share of actions drawn uniformly while exploring (1707.01495, appendix A).
    random_actions_end  to this the share falls, in proportion to the success rate in training
                      (Yang et al., 2022, arXiv 2207.09243, where it ends at 0).
    normalize_observations  to mean 0 and deviation 1, clipped to 5 (1707.01495, appendix A).
    layer_norm        in the critics, which bounds values far from the data (Ball et al., 2023,
                      arXiv 2302.02948, section 4.2).
    n_critics, n_target_critics  a large ensemble, of which a random few give the target (Chen et
                      al., 2021, REDQ, arXiv 2101.05982, algorithm 1), with several
                      ``gradient_steps`` per environment step.
    relay             a goal before the task's (Luo et al., 2022, arXiv 2208.00843), see `relay`.
    bc_weight         imitation of demonstrated actions (Nair et al., 2018, arXiv 1709.10089).
    policy_delay      critic updates per actor update (Fujimoto et al., 2018, arXiv 1802.09477).
    precision         bfloat16 halves the work of matrix products on processors that know it;
                      weights, losses and targets stay float32.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from gymnasium import spaces
from torch import Tensor

from scilab_rl.algorithms.cleansac import parse_ent_coef
from scilab_rl.algorithms.intrinsic.build import make_intrinsic_reward
from scilab_rl.envs.types import Observation
from scilab_rl.errors import ConfigError
from scilab_rl.learning.base import LazyNumber
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

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


@dataclass(frozen=True)
class Settings(UpdateSettings):
    """The constants of an update, for which it is compiled; see `JAXSAC`."""

    learns_ent_coef: bool
    target_entropy: float
    backup_entropy: bool
    scale: float
    bc_weight: float = 0.0
    q_filter: bool = True


class JAXSAC(JaxOffPolicyAlgorithm):
    """Soft actor-critic, compiled.

    Args:
        ent_coef: Weight alpha of the entropy: a number, ``auto`` (learned) or ``auto_0.1``
            (learned, from that initial value).
        target_entropy: Entropy that a learned alpha aims at; ``auto``: -n_actions.
        backup_entropy: Whether the target rewards entropy.
        action_scale_factor: Fraction of the action range that is used.
        bc_weight: Weight of the imitation of demonstrated actions in the actor's loss; needs
            ``demos``. 0: none.
        q_filter: Whether only those are imitated that the critics find better than the actor's.
        intrinsic: A reward that the agent gives itself, mixed into the environment's; see
            `scilab_rl.algorithms.intrinsic`. None: none.
        **common: Learning rate, critics, exploration and so on, see `JaxOffPolicyAlgorithm`.
    """

    supported_action_spaces = (spaces.Box,)
    metrics = (
        "train/ent_coef",
        "train/rollout_logpi_step",
        ("train/ent_coef_loss", "ent_coef is auto", lambda self: self.learns_ent_coef),
        ("train/bc_loss", "bc_weight is above 0", lambda self: self.bc_weight > 0),
    )

    def __init__(
        self,
        *,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        backup_entropy: bool = True,
        action_scale_factor: float = 1.0,
        bc_weight: float = 0.0,
        q_filter: bool = True,
        intrinsic: str | Mapping[str, object] | None = None,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        self.action_scale_factor = action_scale_factor
        self.bc_weight = bc_weight
        self.learns_ent_coef, ent_coef = parse_ent_coef(ent_coef)
        settings = Settings.of(
            self,
            learns_ent_coef=self.learns_ent_coef,
            target_entropy=float(-self.n_actions if target_entropy == "auto" else target_entropy),
            backup_entropy=backup_entropy,
            scale=action_scale_factor,
            bc_weight=bc_weight,
            q_filter=q_filter,
        )
        networks = self.draw_networks(2 * self.n_actions)
        state = initial_state(*networks, ent_coef, self.learning_rate)
        if bc_weight:
            state["actor_losses"]["bc_loss"] = np.float32(0)
        self.start_learning(update, settings, state)
        self.intrinsic = make_intrinsic_reward(intrinsic, self)

    def draw_random_actions(self) -> Tensor:
        """Draw an action for each environment from the range that is used."""
        return self.action_scale_factor * super().draw_random_actions()

    def more_fields(self, n: int) -> dict[str, np.ndarray]:
        """Return which of n transitions are demonstrations, if they are imitated."""
        if not self.bc_weight:
            return {}
        if getattr(self.replay_buffer, "demos", None) is None:
            raise ConfigError(
                "algorithm.bc_weight needs demonstrations: algorithm.demos=scripted:N."
            )
        return {"is_demo": self.replay_buffer.from_demos(n).astype(np.float32)}  # type: ignore[union-attr]

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1], with the networks of the last finished round."""
        mean, log_std = self._gaussian(observations)
        if not deterministic:
            mean = mean + np.exp(log_std) * np.random.standard_normal(mean.shape)
        return torch.as_tensor(self.action_scale_factor * np.tanh(mean), dtype=torch.float32)

    def record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record what the agent of the first environment thinks of what it does."""
        super().record_step(observations, env_actions)
        logpi = LazyNumber(lambda: self.log_prob(observations, env_actions)[0])
        self.logger.record("train/rollout_logpi_step", logpi)

    def log_prob(self, observations: Observation, env_actions: np.ndarray) -> np.ndarray:
        """Return the log density of actions scaled to [-1, 1]. Shapes: ``(batch,)``."""
        mean, log_std = self._gaussian(self.to_vector(observations))
        inside = self.from_env_actions(env_actions) / self.action_scale_factor
        unsquashed = np.arctanh(inside.clip(-1 + 1e-6, 1 - 1e-6))
        noise = (unsquashed - mean) / np.exp(log_std)
        return np.asarray(squashed_log_prob(noise, log_std, unsquashed, self.action_scale_factor))

    def _gaussian(self, observations: Tensor) -> tuple[Array, Array]:
        vectors = self.normalizer(observations.numpy())
        return gaussian(forward(self.rounds.networks["actor"], vectors, xp=np))


def initial_state(actor: Params, critic: Params, ent_coef: float, learning_rate: float) -> State:
    """Return weights, temperature and moments before the first update."""
    with np.errstate(divide="ignore"):  # a temperature of 0 is minus infinity
        log_ent_coef = np.log(np.float32(ent_coef))
    adam = optax.adam(learning_rate)
    return {
        "actor": actor,
        "critic": critic,
        "critic_target": critic,
        "log_ent_coef": log_ent_coef,
        "actor_optimizer": adam.init(actor),
        "critic_optimizer": adam.init(critic),
        "log_ent_coef_optimizer": adam.init(log_ent_coef),
        # Of the last actor update; there may be fewer of them than critic updates.
        "actor_losses": {"actor_loss": np.float32(0), "ent_coef_loss": np.float32(0)},
    }


def update(
    settings: Settings, state: State, batch: Batch, key: Array, index: Array
) -> tuple[State, Losses]:
    """Update critics, then actor and temperature, then target critics; see `UpdateRunner`."""
    target_key, actor_key = jax.random.split(key)
    targets, next_q = soft_targets(settings, state, batch, target_key)
    state, losses = update_critics(settings, state, batch, targets, next_q, critic_loss)
    losses["ent_coef"] = jnp.exp(state["log_ent_coef"])

    def update_actor(state: State) -> State:
        (loss, log_prob), gradient = jax.value_and_grad(actor_loss, has_aux=True)(
            state["actor"], settings, state, batch, actor_key
        )
        actor_losses = state["actor_losses"] | {"actor_loss": loss}
        if settings.bc_weight:
            actor_losses["bc_loss"], imitation = jax.value_and_grad(cloning_loss)(
                state["actor"], settings, state, batch
            )
            gradient = jax.tree.map(lambda g, i: g + settings.bc_weight * i, gradient, imitation)
        state = adam_step(state, "actor", gradient, settings.learning_rate)
        if settings.learns_ent_coef:
            actor_losses["ent_coef_loss"], gradient = jax.value_and_grad(temperature_loss)(
                state["log_ent_coef"], log_prob, settings.target_entropy
            )
            state = adam_step(state, "log_ent_coef", gradient, settings.learning_rate)
        return state | {"actor_losses": actor_losses}

    state = delayed(settings, index, update_actor, state)
    losses |= state["actor_losses"]
    if not settings.learns_ent_coef:
        del losses["ent_coef_loss"]
    return update_targets(state, ["critic"], settings.tau), losses


def soft_targets(settings: Settings, state: State, batch: Batch, key: Array) -> tuple[Array, Array]:
    """Return y, the soft Bellman backup (eq. 3), and the target critics' values.

    Shapes:
        y: ``(batch,)``; values: ``(n_critics, batch)``.
    """
    action_key, subset_key = jax.random.split(key)
    actions, log_prob = sample(
        state["actor"], batch.next_observations, action_key, settings.scale, settings.precision
    )
    next_q = q_values(state["critic_target"], batch.next_observations, actions, settings.precision)
    value = random_subset(next_q, settings.n_target_critics, subset_key).min(axis=0)
    if settings.backup_entropy:
        value -= jnp.exp(state["log_ent_coef"]) * log_prob
    return bellman_targets(settings, batch, value), next_q


def critic_loss(
    critic: Params, batch: Batch, targets: Array, precision: str
) -> tuple[Array, Array]:
    """Return the sum of J(Q_i) over the critics (eq. 5), and their values."""
    loss, q = squared_error(critic, batch, targets, precision)
    return 0.5 * loss, q


def actor_loss(
    actor: Params, settings: Settings, state: State, batch: Batch, key: Array
) -> tuple[Array, Array]:
    """Return J(pi) (eq. 9) and log pi of the sampled actions. Shapes: log pi: ``(batch,)``."""
    actions, log_prob = sample(actor, batch.observations, key, settings.scale, settings.precision)
    q = q_values(state["critic"], batch.observations, actions, settings.precision)
    # The minimum over two critics (eq. 9); the mean over a large ensemble (REDQ, algorithm 1).
    value = q.min(axis=0) if settings.n_target_critics == len(q) else q.mean(axis=0)
    return (jnp.exp(state["log_ent_coef"]) * log_prob - value).mean(), log_prob


def cloning_loss(actor: Params, settings: Settings, state: State, batch: Batch) -> Array:
    """Return the squared distance from demonstrated actions, the mean over the demonstrations.

    With the Q-filter, an action counts only where Q(s, a) > Q(s, pi(s)) (Nair et al., 2018, arXiv
    1709.10089, eq. 5). pi(s) is the most likely action, Q the minimum over the critics.
    """
    mean, _ = gaussian(forward(actor, batch.observations, precision=settings.precision), jnp)
    actions = settings.scale * jnp.tanh(mean)
    assert batch.is_demo is not None
    counts = batch.is_demo
    if settings.q_filter:
        own = jax.lax.stop_gradient(actions)
        demonstrated, chosen = (
            q_values(state["critic"], batch.observations, a, settings.precision).min(axis=0)
            for a in (batch.actions, own)
        )
        counts = counts * (demonstrated > chosen)
    errors = jnp.square(actions - batch.actions).sum(axis=-1)
    return (counts * errors).sum() / jnp.maximum(batch.is_demo.sum(), 1.0)


def temperature_loss(log_ent_coef: Array, log_prob: Array, target_entropy: float) -> Array:
    """Return J(alpha) (eq. 18), with log alpha in the place of alpha."""
    return -(log_ent_coef * (log_prob + target_entropy)).mean()


def sample(
    actor: Params, observations: Array, key: Array, scale: float, precision: str
) -> tuple[Array, Array]:
    """Draw actions that gradients can flow through; return them and their log probabilities.

    Shapes:
        actions: ``(batch, n_actions)``; log probabilities: ``(batch,)``.
    """
    mean, log_std = gaussian(forward(actor, observations, precision=precision), jnp)
    noise = jax.random.normal(key, mean.shape)
    unsquashed = mean + jnp.exp(log_std) * noise
    return scale * jnp.tanh(unsquashed), squashed_log_prob(noise, log_std, unsquashed, scale)


def gaussian(output: Array, xp: ModuleType = np) -> tuple[Array, Array]:
    """Return mean and logarithm of the deviation of a policy, before squashing."""
    mean, log_std = xp.split(output, 2, axis=-1)
    return mean, xp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def squashed_log_prob(noise: Array, log_std: Array, unsquashed: Array, scale: float) -> Array:
    """Return log pi(a|s) of a = scale tanh(u), u = mu + sigma eps (appendix C, eq. 26).

    Shapes:
        noise, log_std, unsquashed: ``(batch, n_actions)``; result: ``(batch,)``.
    """
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    squashing = 2 * (math.log(2) - unsquashed - jax.nn.softplus(-2 * unsquashed)) + math.log(scale)
    return (normal - squashing).sum(axis=-1)
