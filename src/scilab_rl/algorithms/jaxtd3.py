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

Metrics: train/critic_loss, train/actor_loss, train/q_mean, train/critic_variance (over the target
critics), and per environment step train/rollout_q_step.
"""

from __future__ import annotations

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


class Settings(NamedTuple):
    """What an update is compiled for; see `JAXTD3`."""

    learning_rate: float
    gamma: float
    tau: float
    n_target_critics: int
    policy_delay: int
    target_policy_noise: float
    target_noise_clip: float
    action_penalty: float
    precision: str


class JAXTD3(OneFileAlgorithm):
    """Twin delayed deep deterministic policy gradient, compiled.

    Args:
        env: Vector environment with continuous actions.
        learning_rate: Of actor and critics.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Transitions per update.
        tau: How far the target networks follow in each update.
        gamma: Discount factor.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        action_noise: Deviation of the normal noise on actions, as a share of half their range.
        random_actions: Share of uniformly random actions after ``learning_starts``.
        n_critics: Number of critics.
        n_target_critics: How many of them, drawn at random for each update, give the target;
            None: all.
        policy_delay: Critic updates per update of the actor.
        target_policy_noise: Deviation of the noise on the target's actions; 0: none.
        target_noise_clip: Largest noise on the target's actions.
        action_penalty: Weight of the squared actions in the actor's loss.
        bounded_targets: Whether targets are clipped to what returns can be.
        normalize_observations: Whether the networks see observations of unit variance.
        layer_norm: Whether the critics normalise their hidden layers.
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
        learning_rate: float = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int = 1,
        gradient_steps: int = -1,
        action_noise: float = 0.1,
        random_actions: float = 0.0,
        n_critics: int = 2,
        n_target_critics: int | None = None,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        action_penalty: float = 0.0,
        bounded_targets: bool = False,
        normalize_observations: bool = False,
        layer_norm: bool = False,
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
        self.action_noise = action_noise
        self.random_actions = random_actions
        self.bounded_targets = bounded_targets
        self.overlap = overlap

        settings = Settings(
            learning_rate=learning_rate,
            gamma=gamma,
            tau=tau,
            n_target_critics=min(n_target_critics or n_critics, n_critics),
            policy_delay=policy_delay,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            action_penalty=action_penalty,
            precision=precision_named(precision),
        )
        sizes = (self.n_observations, self.n_actions, net_arch)
        state = initial_state(*sizes, n_critics, layer_norm, learning_rate)
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
        random_actions = torch.as_tensor(self.from_env_actions(self.sample_env_actions()))
        if self.num_timesteps < self.learning_starts:
            return random_actions
        actions = self.act(self.to_vector(self._last_obs), deterministic=False)
        is_random = torch.as_tensor(np.random.random((self.n_envs, 1)) < self.random_actions)
        return torch.where(is_random, random_actions, actions)

    def act(self, observations: Tensor, deterministic: bool) -> Tensor:
        """Choose actions in [-1, 1], with the networks of the last finished round."""
        vectors = self.normalizer(observations.numpy())
        actions = np.tanh(forward(self.rounds.networks["actor"], vectors, xp=np))
        if not deterministic:
            noise = self.action_noise * np.random.standard_normal(actions.shape)
            actions = np.clip(actions + noise, -1.0, 1.0)
        return torch.as_tensor(actions, dtype=torch.float32)

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

    def critic(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return what each critic thinks. Shapes: result ``(batch, n_critics)``."""
        inputs = np.hstack([self.normalizer(observations.numpy()), actions.numpy()])
        values = forward(self.rounds.networks["critic"], inputs, xp=np)
        return torch.as_tensor(values[..., 0].T, dtype=torch.float32)

    def q_values(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return what each critic thinks of a batch of steps. Shapes: ``(batch, n_critics)``."""
        actions = torch.as_tensor(self.from_env_actions(env_actions))
        return self.critic(self.to_vector(observations), actions)


def initial_state(
    n_observations: int,
    n_actions: int,
    net_arch: Sequence[int],
    n_critics: int,
    layer_norm: bool,
    learning_rate: float,
) -> State:
    """Return weights and moments before the first update."""
    actor = dense_layers([n_observations, *net_arch, n_actions])
    critic = dense_layers(
        [n_observations + n_actions, *net_arch, 1], n=n_critics, layer_norm=layer_norm
    )
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
) -> tuple[State, dict[str, Array]]:
    """Update critics, then actor, then target networks; pure.

    Args:
        settings: Constants.
        state: As `initial_state` makes it.
        batch: Transitions.
        key: Of this update's random numbers.
        index: Number of updates before this one.

    Returns:
        The new state and the losses.
    """
    targets, next_q = smoothed_targets(settings, state, batch, key)
    (loss, q), gradient = jax.value_and_grad(critic_loss, has_aux=True)(
        state["critic"], batch, targets, settings.precision
    )
    state = descend(state, "critic", gradient, settings.learning_rate)
    losses = {
        "critic_loss": loss,
        "q_mean": q.mean(),
        "critic_variance": next_q.var(axis=0).mean(),
    }

    def update_actor(state: State) -> State:
        loss, gradient = jax.value_and_grad(actor_loss)(state["actor"], settings, state, batch)
        return descend(state, "actor", gradient, settings.learning_rate) | {"actor_loss": loss}

    if settings.policy_delay == 1:
        state = update_actor(state)
    else:
        is_due = index % settings.policy_delay == 0
        state = jax.lax.cond(is_due, update_actor, lambda state: state, state)
    for name in ("actor", "critic"):
        target = optax.incremental_update(state[name], state[f"{name}_target"], settings.tau)
        state |= {f"{name}_target": target}
    return state, losses | {"actor_loss": state["actor_loss"]}


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
    asked = next_q
    if settings.n_target_critics < len(next_q):
        chosen = jax.random.permutation(subset_key, len(next_q))[: settings.n_target_critics]
        asked = next_q[chosen]
    targets = batch.rewards + settings.gamma * (1 - batch.dones) * asked.min(axis=0)
    return jnp.clip(targets, *batch.return_bounds), next_q


def critic_loss(
    critic: Params, batch: Batch, targets: Array, precision: str
) -> tuple[Array, Array]:
    """Return the sum of J(Q_i) over the critics (algorithm 1), and their values.

    Shapes:
        targets: ``(batch,)``; values: ``(n_critics, batch)``.
    """
    q = q_values(critic, batch.observations, batch.actions, precision)
    return jnp.square(q - targets).mean(axis=1).sum(), q


def actor_loss(actor: Params, settings: Settings, state: State, batch: Batch) -> Array:
    """Return J(pi): minus the first critic's value, plus the penalty on large actions."""
    actions = policy(actor, batch.observations, settings.precision)
    first = jax.tree.map(lambda values: values[:1], state["critic"])
    q = q_values(first, batch.observations, actions, settings.precision)
    return settings.action_penalty * jnp.square(actions).mean() - q.mean()


def policy(actor: Params, observations: Array, precision: str) -> Array:
    """Return pi(s) in [-1, 1]. Shapes: ``(batch, n_actions)``."""
    return jnp.tanh(forward(actor, observations, precision=precision))


def q_values(critic: Params, observations: Array, actions: Array, precision: str) -> Array:
    """Return the value that each critic gives to each pair. Shapes: ``(n_critics, batch)``."""
    inputs = jnp.concatenate([observations, actions], axis=-1)
    return forward(critic, inputs, precision=precision)[..., 0]


def descend(state: State, name: str, gradient: Any, learning_rate: float) -> State:
    """Take one step of Adam with one entry of the state."""
    optimizer = f"{name}_optimizer"
    step, moments = optax.adam(learning_rate).update(gradient, state[optimizer])
    return state | {name: optax.apply_updates(state[name], step), optimizer: moments}
