"""The loop of off-policy algorithms: steps go into a replay buffer, updates learn from its samples.

Nothing here knows what is learned. An algorithm's own file has its networks and its equations.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from stable_baselines3.her import HerReplayBuffer
from torch import Tensor

from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import VecStep, at_ends
from scilab_rl.learning.base import LazyNumber, OneFileAlgorithm
from scilab_rl.learning.declared import MetricEntry
from scilab_rl.learning.replay import HindsightReplayBuffer


class BatchReward(Protocol):
    """A reward that the agent gives itself, see `scilab_rl.algorithms.intrinsic`."""

    def apply(self, batch: ReplayBufferSamples) -> ReplayBufferSamples:
        """Return a batch with this reward mixed into the environment's."""


class OffPolicyAlgorithm(OneFileAlgorithm):
    """Collects steps and learns from a replay buffer, by turns.

    A subclass makes its networks in its constructor, then calls `make_replay_buffer`, and adds
    `act`, `update` and `action_values`.

    Args:
        env: Vector environment to learn in.
        learning_rate: Of the networks.
        buffer_size: Transitions that the replay buffer holds.
        learning_starts: Environment steps with random actions before the first update.
        batch_size: Transitions per update.
        tau: How far the target networks move towards the learned ones in each update.
        gamma: Discount factor.
        train_freq: Steps of each environment between rounds of updates.
        gradient_steps: Updates per round; -1: as many as steps were collected.
        replay_buffer_class: None: a plain replay buffer.
        replay_buffer_kwargs: Further arguments of the replay buffer.
        seed, device: See `OneFileAlgorithm`.

    Attributes:
        replay_buffer: Set by `make_replay_buffer`.
        intrinsic: A reward that the agent gives itself; None: none.
    """

    metrics: ClassVar[Sequence[MetricEntry]] = ("train/rollout_q_step",)

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
        gradient_steps: int = 1,
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
        self.replay_buffer: ReplayBuffer | None = None
        self.intrinsic: BatchReward | None = None
        self._buffer_size = buffer_size
        self._buffer_class = replay_buffer_class
        self._buffer_kwargs = dict(replay_buffer_kwargs or {})
        # The replay buffer stores what the environment gave before VecNormalize changed it.
        self._last_original_obs: Any = None
        self._vec_normalize_env = unwrap_vec_normalize(env)

    def update(self, batch: ReplayBufferSamples) -> dict[str, Tensor]:
        """Learn from a batch once.

        Args:
            batch: From `sample`.

        Returns:
            Losses and other numbers by their names in `record_losses`, each a scalar.
        """
        raise NotImplementedError

    @abstractmethod
    def action_values(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Return what each critic thinks of actions, in the units in which the algorithm learns.

        Shapes:
            observations: ``(batch, n_observations)``; actions: ``(batch, n_actions)``, or
            ``(batch, 1)`` if discrete; result: ``(batch, n_critics)``.
        """

    def iterate(self, callback: BaseCallback) -> bool:
        """Collect ``train_freq`` steps of each environment, then update."""
        if not self.collect(callback):
            return False
        if self.num_timesteps > self.learning_starts:
            self.train(self.updates_per_round)
        return True

    def train(self, gradient_steps: int) -> None:
        """Do some updates, each with a batch of its own, and record the means."""
        losses: dict[str, list[Tensor]] = defaultdict(list)
        for _ in range(gradient_steps):
            for name, loss in self.update(self.sample(self.batch_size)).items():
                losses[name].append(loss)
            self.n_updates += 1
        self.record_losses(losses)

    @property
    def updates_per_round(self) -> int:
        """Number of updates after each round of collecting."""
        as_collected = self.train_freq * self.n_envs
        return self.gradient_steps if self.gradient_steps >= 0 else as_collected

    def collect(self, callback: BaseCallback) -> bool:
        """Act and store what happens; return False if the callback stops."""
        callback.on_rollout_start()
        for _ in range(self.train_freq):
            actions = self.explore()
            env_actions = self.to_env_actions(actions)
            self.record_step(self._last_obs, env_actions)
            step = self.step(env_actions, callback)
            if step is None:
                return False
            self.store(step, actions.cpu().numpy())
        callback.on_rollout_end()
        return True

    def explore(self) -> Tensor:
        """Choose the actions for the next step: random ones at first, then those of `act`."""
        if self.num_timesteps < self.learning_starts:
            return self.draw_random_actions()
        with torch.no_grad():
            return self.act(self.to_vector(self._last_obs), deterministic=False)

    def draw_random_actions(self) -> Tensor:
        """Draw an action for each environment."""
        return torch.as_tensor(self.from_env_actions(self.sample_env_actions()))

    def record_step(self, observations: Observation, env_actions: np.ndarray) -> None:
        """Record what the agent of the first environment thinks of what it does."""
        q = LazyNumber(lambda: self.q_values(observations, env_actions)[0].min())
        self.logger.record("train/rollout_q_step", q)

    @torch.no_grad()
    def q_values(self, observations: Observation, env_actions: np.ndarray) -> Tensor:
        """Return what each critic thinks of a batch of steps. Shapes: ``(batch, n_critics)``."""
        return self.action_values(self.to_vector(observations), self.to_actions(env_actions))

    def to_actions(self, env_actions: np.ndarray) -> Tensor:
        """Turn the environment's actions into a tensor of the algorithm's."""
        return torch.as_tensor(self.from_env_actions(env_actions), device=self.device)

    def make_replay_buffer(self) -> None:
        """Make the replay buffer that the arguments name, to fit the environment."""
        buffer_class, arguments = self._buffer_class, self._buffer_kwargs
        if buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            buffer_class = DictReplayBuffer if is_dict else ReplayBuffer
        if issubclass(buffer_class, HerReplayBuffer):
            arguments = arguments | {"env": self.env}
        self.replay_buffer = buffer_class(
            self._buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            **arguments,
        )

    def store(self, step: VecStep, actions: np.ndarray) -> None:
        """Add a step to the replay buffer, as the environment gave it before normalization.

        Args:
            step: What happened.
            actions: In the units in which the algorithm learns.
        """
        assert self.replay_buffer is not None
        observations: Any = step.observations
        next_obs: Any = step.next_observations
        rewards = step.rewards
        if (normalization := self._vec_normalize_env) is not None:
            new_obs = normalization.get_original_obs()
            observations, rewards = self._last_original_obs, normalization.get_original_reward()
            next_obs = new_obs
            if step.dones.any():
                last = normalization.unnormalize_obs(step.next_observations)
                next_obs = at_ends(step.dones, last, new_obs)
            self._last_original_obs = new_obs
        self.replay_buffer.add(observations, next_obs, actions, rewards, step.dones, step.infos)

    def sample(self, batch_size: int) -> ReplayBufferSamples:
        """Draw transitions to learn from, with observations as vectors.

        An intrinsic reward is mixed into theirs, and learns from them.

        Shapes:
            observations, next_observations: ``(batch, n_observations)``;
            actions: ``(batch, n_actions)``; rewards, dones: ``(batch, 1)``. ``dones`` is 1 only
            where the episode ended in a terminal state.
        """
        batch = self._stored_transitions(batch_size)
        return batch if self.intrinsic is None else self.intrinsic.apply(batch)

    def _stored_transitions(self, batch_size: int) -> ReplayBufferSamples:
        assert self.replay_buffer is not None
        if isinstance(self.replay_buffer, HindsightReplayBuffer):
            return self.replay_buffer.sample_vectors(batch_size, env=self._vec_normalize_env)
        batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        return ReplayBufferSamples(
            observations=self.to_vector(batch.observations),
            actions=batch.actions,
            next_observations=self.to_vector(batch.next_observations),
            dones=batch.dones,
            rewards=batch.rewards,
        )

    def _break_off(self, observations: Any) -> None:
        super()._break_off(observations)
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._vec_normalize_env.get_original_obs()
        if isinstance(self.replay_buffer, HerReplayBuffer):
            # No goal is taken from what comes after a gap.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what it warns about is what is wanted here
                self.replay_buffer.truncate_last_trajectory()
