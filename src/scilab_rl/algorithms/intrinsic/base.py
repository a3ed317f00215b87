"""The base of intrinsic rewards: how they are scaled, mixed with the task's reward, and learned.

In every batch that the algorithm learns from, the environment's reward r_e is replaced by

    r = (1 - w) r_e + w r_i / scale,        w = ``weight``,

with the scale by ``normalize``. Then the models behind r_i learn from the batch. Random numbers are
drawn from a generator of its own, so that ``weight: 0`` changes nothing at all.

The framework records the reward of each step and its sum over episodes, see `INTRINSIC_METRICS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import numpy as np
import torch
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from torch import Tensor

from scilab_rl.algorithms.intrinsic.agents import Agent
from scilab_rl.algorithms.intrinsic.normalization import NORMALIZATIONS, RunningMoments
from scilab_rl.envs.vec_step import Observation
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.learning.declared import MetricEntry
from scilab_rl.learning.finite import check_finite
from scilab_rl.learning.observations import Tensors

B = TypeVar("B", ReplayBufferSamples, DictReplayBufferSamples)
_LARGEST_STATE = 5.0  # standard deviations (Burda et al., 2018, section 2.4)


class IntrinsicReward(ABC):
    """A reward that an agent gives itself.

    A subclass adds `reward` and, if it learns something, ``self.optimizer`` and `loss`.

    Args:
        agent: The algorithm that is rewarded.
        weight: w, from 0 (only the environment's reward) to 1 (only this one).
        normalize: ``running_std``, ``min_max`` (of each batch) or ``none``.
        normalize_states: Whether models see states in units of their standard deviation so far,
            and at most 5 of them.
        seed: Of its own random numbers.

    Attributes:
        optimizer: Of the learned models; None where nothing is learned.
        n_updates: Gradient steps so far.
        metrics: What it records, see `scilab_rl.learning.declared`.
    """

    metrics: ClassVar[Sequence[MetricEntry]] = (
        "train/intrinsic_reward",  # scaled, mean over the batch
        ("train/intrinsic_loss", "it learns models", lambda self: self.optimizer is not None),
    )

    def __init__(
        self,
        agent: Agent,
        *,
        weight: float = 0.1,
        normalize: str = "running_std",
        normalize_states: bool = True,
        seed: int = 0,
    ) -> None:
        if not 0 <= weight <= 1:
            raise ConfigError(
                f"algorithm.intrinsic.weight must be from 0 to 1, but it is {weight}."
            )
        if normalize not in NORMALIZATIONS:
            raise ConfigError(
                f"algorithm.intrinsic.normalize must be one of {', '.join(NORMALIZATIONS)}, but it "
                f"is {normalize!r}.{did_you_mean(str(normalize), NORMALIZATIONS)}"
            )
        self.agent = agent
        self.weight = weight
        self.normalization = NORMALIZATIONS[normalize](agent.device)
        self.state_moments = RunningMoments((agent.n_states,), agent.device)
        self.normalize_states = normalize_states
        self.random = np.random.default_rng(seed)
        self.optimizer: torch.optim.Optimizer | None = None
        self.n_updates = 0

    @abstractmethod
    def reward(self, observations: Tensors, actions: Tensor, next_observations: Tensors) -> Tensor:
        """Return r_i of a batch, unscaled and without a gradient; draws no random numbers.

        Shapes:
            observations, next_observations: as the algorithm's networks read them;
            actions: ``(batch, ...)``, as the algorithm learns from them; result: ``(batch,)``.
        """

    def loss(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return what the models minimise.

        Shapes:
            states, next_states: ``(batch, n_states)``; actions: ``(batch, n_actions)``;
            result: scalar.
        """
        raise NotImplementedError

    def vectors(
        self, observations: Tensors, actions: Tensor, next_observations: Tensors
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, actions and next states as models read them.

        Shapes:
            states, next states: ``(batch, n_states)``; actions: ``(batch, n_actions)``.
        """
        states, next_states = map(self.agent.states, (observations, next_observations))
        return self._in_units(states), self.agent.actions(actions), self._in_units(next_states)

    def update(
        self,
        observations: Tensors,
        actions: Tensor,
        next_observations: Tensors,
        batch_size: int | None = None,
    ) -> None:
        """Learn from transitions.

        Args:
            observations: As for `reward`.
            actions: As for `reward`.
            next_observations: As for `reward`.
            batch_size: Transitions per gradient step; None: one step with all of them.
        """
        if self.optimizer is None:
            return
        if self.normalize_states:
            self.state_moments.update(self.agent.states(next_observations))
        transitions = self.vectors(observations, actions, next_observations)
        losses = []
        order = torch.as_tensor(self.random.permutation(len(actions)))
        for indices in order.split(batch_size or len(actions)):
            with torch.enable_grad():
                loss = self.loss(*(part[indices.to(part.device)] for part in transitions))
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.n_updates += 1
            losses.append(loss.detach())
        check_finite("intrinsic_loss", torch.stack(losses), self.n_updates)
        self.agent.record("train/intrinsic_loss", torch.stack(losses).mean())

    def mix(
        self,
        rewards: Tensor,
        observations: Tensors,
        actions: Tensor,
        next_observations: Tensors,
        batch_size: int | None = None,
    ) -> Tensor:
        """Return r for a batch of r_e, then learn from the batch.

        Args:
            rewards: r_e. Shapes: ``(batch,)`` or ``(batch, 1)``, as the result.
            observations: As for `reward`.
            actions: As for `reward`.
            next_observations: As for `reward`.
            batch_size: Transitions per gradient step of the models; None: all.

        Raises:
            NumericalError: If r_i or the loss is not finite.
        """
        with torch.no_grad():
            intrinsic = self.reward(observations, actions, next_observations)
            self.normalization.update(intrinsic)
            intrinsic = self.normalization.apply(intrinsic)
        check_finite("intrinsic_reward", intrinsic.sum(), self.n_updates)
        self.agent.record("train/intrinsic_reward", intrinsic.mean())
        self.update(observations, actions, next_observations, batch_size)
        return (1 - self.weight) * rewards + self.weight * intrinsic.view_as(rewards)

    def apply(self, batch: B) -> B:
        """Return a sampled batch of a replay buffer with r in the place of r_e."""
        transitions = (batch.observations, batch.actions, batch.next_observations)
        return batch._replace(rewards=self.mix(batch.rewards, *transitions))

    @torch.no_grad()
    def evaluate(
        self, observations: Observation, env_actions: np.ndarray, next_observations: Observation
    ) -> Tensor:
        """Return the scaled r_i of steps, as a vector environment gives them.

        Shapes:
            all entries: ``(n_envs, ...)``; result: ``(n_envs,)``.
        """
        before, actions = self.agent.as_sampled(observations, env_actions)
        after, _ = self.agent.as_sampled(next_observations, env_actions)
        return self.normalization.apply(self.reward(before, actions, after))

    def _in_units(self, states: Tensor) -> Tensor:
        if not self.normalize_states:
            return states
        deviations = (states - self.state_moments.mean) / self.state_moments.scale
        return deviations.clamp(-_LARGEST_STATE, _LARGEST_STATE)
