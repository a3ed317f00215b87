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
    backup_entropy    whether y rewards entropy (eq. 3); without, y is bounded by the rewards alone.
    random_actions    share of actions drawn uniformly while exploring (1707.01495, appendix A).
    normalize_observations  to mean 0 and deviation 1, clipped to 5 (1707.01495, appendix A).
    layer_norm        in the critics, which bounds values far from the data (Ball et al., 2023,
                      arXiv 2302.02948, section 4.2).
    n_critics, n_target_critics  a large ensemble, of which a random few give the target (Chen et
                      al., 2021, REDQ, arXiv 2101.05982, algorithm 1), with several
                      ``gradient_steps`` per environment step.
    policy_delay      critic updates per actor update (Fujimoto et al., 2018, arXiv 1802.09477).
    precision         bfloat16 halves the work of matrix products on processors that know it;
                      weights, losses and targets stay float32.

Metrics: train/critic_loss, train/actor_loss, train/ent_coef, train/ent_coef_loss, train/q_mean,
train/critic_variance (over the target critics), and per environment step train/rollout_q_step and
train/rollout_logpi_step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from gymnasium import spaces
from jax import Array
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from scilab_rl.algorithms.base import LazyNumber, Observation, OneFileAlgorithm
from scilab_rl.algorithms.cleansac import parse_ent_coef
from scilab_rl.algorithms.intrinsic.build import make_intrinsic_reward
from scilab_rl.algorithms.jax_engine import (
    Batch,
    Normalizer,
    Params,
    Rounds,
    State,
    as_updates,
    dense_layers,
    forward,
    precision_named,
    widest_returns,
)

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


class Settings(NamedTuple):
    """What an update is compiled for; see `JAXSAC`."""

    learning_rate: float
    gamma: float
    tau: float
    learns_ent_coef: bool
    target_entropy: float
    n_target_critics: int
    policy_delay: int
    backup_entropy: bool
    scale: float
    precision: str


class JAXSAC(OneFileAlgorithm):
    """Soft actor-critic, compiled.

    Args:
        env: Vector environment with continuous actions.
        learning_rate: Of actor, critics and temperature.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Transitions per update.
        tau: How far the target critics follow in each update.
        gamma: Discount factor.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        ent_coef: Weight alpha of the entropy: a number, ``auto`` (learned) or ``auto_0.1``
            (learned, from that initial value).
        target_entropy: Entropy that a learned alpha aims at; ``auto``: -n_actions.
        n_critics: Number of critics.
        n_target_critics: How many of them, drawn at random for each update, give the target;
            None: all.
        policy_delay: Critic updates per update of actor and temperature.
        backup_entropy: Whether the target rewards entropy.
        bounded_targets: Whether targets are clipped to what returns can be.
        random_actions: Share of uniformly random actions after ``learning_starts``.
        normalize_observations: Whether the networks see observations of unit variance.
        layer_norm: Whether the critics normalise their hidden layers.
        action_scale_factor: Fraction of the action range that is used.
        net_arch: Sizes of the hidden layers of actor and critics.
        precision: ``float32`` or ``bfloat16``, of the matrix products.
        overlap: Whether the environments step while a round of updates computes.
        replay_buffer_class: None: a plain replay buffer.
        replay_buffer_kwargs: Further arguments of the replay buffer.
        intrinsic: A reward that the agent gives itself, mixed into the environment's; see
            `scilab_rl.algorithms.intrinsic`. None: none.
        seed: See `OneFileAlgorithm`.
        device: Where JAX computes: ``auto`` (a GPU if JAX has one), ``cpu`` or ``cuda``.
    """

    supported_action_spaces = (spaces.Box,)

    def __init__(
        self,
        *,
        env: VecEnv,
        learning_rate: float = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int = 1,
        gradient_steps: int = -1,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        n_critics: int = 2,
        n_target_critics: int | None = None,
        policy_delay: int = 1,
        backup_entropy: bool = True,
        bounded_targets: bool = False,
        random_actions: float = 0.0,
        normalize_observations: bool = False,
        layer_norm: bool = False,
        action_scale_factor: float = 1.0,
        net_arch: Sequence[int] = (256, 256),
        precision: str = "float32",
        overlap: bool = True,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        intrinsic: str | Mapping[str, Any] | None = None,
        seed: int | None = None,
        device: str = "auto",
    ) -> None:
        super().__init__(env=env, seed=seed, device="cpu")  # where PyTorch is: at the buffer
        self.learning_rate = learning_rate
        self.learning_starts = learning_starts
        self.batch_size = batch_size
        self.gamma = gamma
        self.train_freq = train_freq
        self.gradient_steps = gradient_steps
        self.bounded_targets = bounded_targets
        self.random_actions = random_actions
        self.action_scale_factor = action_scale_factor
        self.overlap = overlap

        learns_ent_coef, ent_coef = parse_ent_coef(ent_coef)
        settings = Settings(
            learning_rate=learning_rate,
            gamma=gamma,
            tau=tau,
            learns_ent_coef=learns_ent_coef,
            target_entropy=float(-self.n_actions if target_entropy == "auto" else target_entropy),
            n_target_critics=min(n_target_critics or n_critics, n_critics),
            policy_delay=policy_delay,
            backup_entropy=backup_entropy,
            scale=action_scale_factor,
            precision=precision_named(precision),
        )
        sizes = (self.n_observations, self.n_actions, net_arch)
        state = initial_state(*sizes, n_critics, layer_norm, ent_coef, learning_rate)
        self.rounds = Rounds(partial(update, settings), state, ["actor", "critic"], device)
        self.normalizer = Normalizer(self.n_observations, active=normalize_observations)
        self.reward_bounds = np.array([np.inf, -np.inf])

        self.replay_buffer = self.make_replay_buffer(
            buffer_size, replay_buffer_class, replay_buffer_kwargs
        )
        self.intrinsic = make_intrinsic_reward(intrinsic, self)

    def iterate(self, callback: BaseCallback) -> bool:
        """Collect steps while the last round of updates computes, then start the next round."""
        if not self.collect(callback):
            return False
        batch = self.draw() if self.num_timesteps > self.learning_starts else None
        self.finish_round()
        if batch is not None:
            self.rounds.start(batch)
        if not self.overlap:
            self.finish_round()
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
            self.store(step, actions.numpy())
            self.normalizer.update(self.to_vector(step.next_observations).numpy())
        callback.on_rollout_end()
        return True

    def explore(self) -> Tensor:
        """Choose the actions for the next step: random ones at first, and later now and then."""
        uniform = torch.as_tensor(self.from_env_actions(self.sample_env_actions()))
        random_actions = self.action_scale_factor * uniform
        if self.num_timesteps < self.learning_starts:
            return random_actions
        actions = self.act(self.to_vector(self._last_obs), deterministic=False)
        is_random = torch.as_tensor(np.random.random((self.n_envs, 1)) < self.random_actions)
        return torch.where(is_random, random_actions, actions)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1], with the networks of the last finished round."""
        mean, log_std = self._gaussian(observations)
        if not deterministic:
            mean = mean + np.exp(log_std) * np.random.standard_normal(mean.shape)
        return torch.as_tensor(self.action_scale_factor * np.tanh(mean), dtype=torch.float32)

    def draw(self) -> Batch:
        """Draw the transitions of the next round."""
        n_updates = self.gradient_steps
        if n_updates < 0:
            n_updates = self.train_freq * self.n_envs
        batch = self.sample(n_updates * self.batch_size)
        if self.intrinsic is not None:
            batch = self.intrinsic.add_to(batch)
        rewards = batch.rewards.numpy().ravel()
        bounds = np.array([-np.inf, np.inf], dtype=np.float32)
        if self.bounded_targets:
            bounds = widest_returns(rewards, self.gamma, self.reward_bounds)
        return as_updates(
            n_updates,
            observations=self.normalizer(batch.observations.numpy()),
            actions=batch.actions.numpy(),
            rewards=rewards,
            next_observations=self.normalizer(batch.next_observations.numpy()),
            dones=batch.dones.numpy().ravel(),
            return_bounds=np.tile(bounds, n_updates),
        )

    def finish_round(self) -> None:
        """Wait for the round under way, and record how it went."""
        losses = self.rounds.finish(
            learning_rate=self.learning_rate, gamma=self.gamma, batch_size=self.batch_size
        )
        self.n_updates = self.rounds.n_started
        for name, values in losses.items():
            self.logger.record(f"train/{name}", values.mean())

    def _record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record what the agent of the first environment thinks of what it does."""
        q = LazyNumber(lambda: self.q_values(observations, env_actions)[0].min())
        self.logger.record("train/rollout_q_step", q)
        logpi = LazyNumber(lambda: self.log_prob(observations, env_actions)[0])
        self.logger.record("train/rollout_logpi_step", logpi)

    def critic(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return what each critic thinks. Shapes: result ``(batch, n_critics)``."""
        inputs = np.hstack([self.normalizer(observations.numpy()), actions.numpy()])
        values = forward(self.rounds.networks["critic"], inputs, xp=np)
        return torch.as_tensor(values[..., 0].T, dtype=torch.float32)

    def q_values(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return what each critic thinks of a batch of steps. Shapes: ``(batch, n_critics)``."""
        actions = torch.as_tensor(self.from_env_actions(env_actions))
        return self.critic(self.to_vector(observations), actions)

    def log_prob(self, observations: Observation, env_actions: np.ndarray) -> np.ndarray:
        """Return the log density of actions scaled to [-1, 1]. Shapes: ``(batch,)``."""
        mean, log_std = self._gaussian(self.to_vector(observations))
        inside = self.from_env_actions(env_actions) / self.action_scale_factor
        unsquashed = np.arctanh(inside.clip(-1 + 1e-6, 1 - 1e-6))
        noise = (unsquashed - mean) / np.exp(log_std)
        return np.asarray(squashed_log_prob(noise, log_std, unsquashed, self.action_scale_factor))

    def _gaussian(self, observations: Tensor) -> tuple[np.ndarray, np.ndarray]:
        vectors = self.normalizer(observations.numpy())
        return gaussian(forward(self.rounds.networks["actor"], vectors, xp=np))


def initial_state(
    n_observations: int,
    n_actions: int,
    net_arch: Sequence[int],
    n_critics: int,
    layer_norm: bool,
    ent_coef: float,
    learning_rate: float,
) -> State:
    """Return weights, temperature and moments before the first update."""
    actor = dense_layers([n_observations, *net_arch, 2 * n_actions])
    critic = dense_layers(
        [n_observations + n_actions, *net_arch, 1], n=n_critics, layer_norm=layer_norm
    )
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
) -> tuple[State, dict[str, Array]]:
    """Update critics, then actor and temperature, then target critics; pure.

    Args:
        settings: Constants.
        state: As `initial_state` makes it.
        batch: Transitions.
        key: Of this update's random numbers.
        index: Number of updates before this one.

    Returns:
        The new state and the losses.
    """
    target_key, actor_key = jax.random.split(key)
    targets, next_q = soft_targets(settings, state, batch, target_key)
    (loss, q), gradient = jax.value_and_grad(critic_loss, has_aux=True)(
        state["critic"], batch, targets, settings.precision
    )
    state = descend(state, "critic", gradient, settings.learning_rate)
    losses = {
        "critic_loss": loss,
        "q_mean": q.mean(),
        "critic_variance": next_q.var(axis=0).mean(),
        "ent_coef": jnp.exp(state["log_ent_coef"]),
    }

    def update_actor(state: State) -> State:
        (loss, log_prob), gradient = jax.value_and_grad(actor_loss, has_aux=True)(
            state["actor"], settings, state, batch, actor_key
        )
        state = descend(state, "actor", gradient, settings.learning_rate)
        actor_losses = state["actor_losses"] | {"actor_loss": loss}
        if settings.learns_ent_coef:
            actor_losses["ent_coef_loss"], gradient = jax.value_and_grad(temperature_loss)(
                state["log_ent_coef"], log_prob, settings.target_entropy
            )
            state = descend(state, "log_ent_coef", gradient, settings.learning_rate)
        return state | {"actor_losses": actor_losses}

    if settings.policy_delay == 1:
        state = update_actor(state)
    else:
        is_due = index % settings.policy_delay == 0
        state = jax.lax.cond(is_due, update_actor, lambda state: state, state)
    state["critic_target"] = optax.incremental_update(
        state["critic"], state["critic_target"], settings.tau
    )
    return state, losses | state["actor_losses"]


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
    asked = next_q
    if settings.n_target_critics < len(next_q):
        chosen = jax.random.permutation(subset_key, len(next_q))[: settings.n_target_critics]
        asked = next_q[chosen]
    value = asked.min(axis=0)
    if settings.backup_entropy:
        value -= jnp.exp(state["log_ent_coef"]) * log_prob
    targets = batch.rewards + settings.gamma * (1 - batch.dones) * value
    return jnp.clip(targets, *batch.return_bounds), next_q


def critic_loss(
    critic: Params, batch: Batch, targets: Array, precision: str
) -> tuple[Array, Array]:
    """Return the sum of J(Q_i) over the critics (eq. 5), and their values.

    Shapes:
        targets: ``(batch,)``; values: ``(n_critics, batch)``.
    """
    q = q_values(critic, batch.observations, batch.actions, precision)
    return 0.5 * jnp.square(q - targets).mean(axis=1).sum(), q


def actor_loss(
    actor: Params, settings: Settings, state: State, batch: Batch, key: Array
) -> tuple[Array, Array]:
    """Return J(pi) (eq. 9) and log pi of the sampled actions. Shapes: log pi: ``(batch,)``."""
    actions, log_prob = sample(actor, batch.observations, key, settings.scale, settings.precision)
    q = q_values(state["critic"], batch.observations, actions, settings.precision)
    # The minimum over two critics (eq. 9); the mean over a large ensemble (REDQ, algorithm 1).
    value = q.min(axis=0) if settings.n_target_critics == len(q) else q.mean(axis=0)
    return (jnp.exp(state["log_ent_coef"]) * log_prob - value).mean(), log_prob


def temperature_loss(log_ent_coef: Array, log_prob: Array, target_entropy: float) -> Array:
    """Return J(alpha) (eq. 18), with log alpha in the place of alpha."""
    return -(log_ent_coef * (log_prob + target_entropy)).mean()


def q_values(critic: Params, observations: Array, actions: Array, precision: str) -> Array:
    """Return the value that each critic gives to each pair. Shapes: ``(n_critics, batch)``."""
    inputs = jnp.concatenate([observations, actions], axis=-1)
    return forward(critic, inputs, precision=precision)[..., 0]


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


def gaussian(output: Any, xp: Any = np) -> tuple[Any, Any]:
    """Return mean and logarithm of the deviation of a policy, before squashing."""
    mean, log_std = xp.split(output, 2, axis=-1)
    return mean, xp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)


def squashed_log_prob(noise: Any, log_std: Any, unsquashed: Any, scale: float) -> Array:
    """Return log pi(a|s) of a = scale tanh(u), u = mu + sigma eps (appendix C, eq. 26).

    Shapes:
        noise, log_std, unsquashed: ``(batch, n_actions)``; result: ``(batch,)``.
    """
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    squashing = 2 * (math.log(2) - unsquashed - jax.nn.softplus(-2 * unsquashed)) + math.log(scale)
    return (normal - squashing).sum(axis=-1)


def descend(state: State, name: str, gradient: Any, learning_rate: float) -> State:
    """Take one step of Adam with one entry of the state."""
    optimizer = f"{name}_optimizer"
    step, moments = optax.adam(learning_rate).update(gradient, state[optimizer])
    return state | {name: optax.apply_updates(state[name], step), optimizer: moments}
