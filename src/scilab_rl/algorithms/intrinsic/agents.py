"""An algorithm as an intrinsic reward sees it: one face for one-file ones and Stable-Baselines3."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import Tensor

from scilab_rl.envs.vec_step import Observation
from scilab_rl.learning.base import OneFileAlgorithm
from scilab_rl.learning.observations import Tensors, state_columns, to_vector


class Agent(ABC):
    """The part of an algorithm that an intrinsic reward may use.

    A *state* is an observation as a vector, without the desired goal, which is a wish of the agent
    and nothing that happens.

    Args:
        algorithm: The algorithm; its networks may not exist yet.
    """

    def __init__(self, algorithm: Any) -> None:
        self.algorithm = algorithm
        self.state_columns = torch.tensor(state_columns(algorithm.observation_space))
        self.state_columns = self.state_columns.to(self.device)

    @property
    def device(self) -> torch.device:
        """Where the algorithm computes."""
        return self.algorithm.device

    @property
    def n_states(self) -> int:
        """Length of a state."""
        return len(self.state_columns)

    @property
    def n_actions(self) -> int:
        """Length of an action as a vector: a discrete action is one-hot."""
        return spaces.flatdim(self.algorithm.action_space)

    @property
    def has_discrete_actions(self) -> bool:
        """Kind of the actions."""
        return isinstance(self.algorithm.action_space, spaces.Discrete)

    def states(self, observations: Tensors) -> Tensor:
        """Return the state of each observation. Shapes: ``(batch, n_states)``."""
        return self.vectors(observations)[:, self.state_columns]

    def actions(self, actions: Tensor) -> Tensor:
        """Turn the algorithm's actions into vectors. Shapes: ``(batch, n_actions)``."""
        if self.has_discrete_actions:
            return F.one_hot(actions.long().flatten(), self.n_actions).float()
        return actions.float().clamp(-1.0, 1.0)  # what an environment does with actions beyond

    def record(self, name: str, value: Tensor) -> None:
        """Record a metric."""
        self.algorithm.logger.record(name, value)

    @property
    @abstractmethod
    def n_critics(self) -> int:
        """Number of action-value networks; 0 where there are none."""

    @abstractmethod
    def q_values(self, observations: Tensors, actions: Tensor) -> Tensor:
        """Return what each critic says. Shapes: ``(batch, n_critics)``."""

    @abstractmethod
    def vectors(self, observations: Tensors) -> Tensor:
        """Return observations as vectors. Shapes: ``(batch, n_observations)``."""

    @abstractmethod
    def as_sampled(
        self, observations: Observation, env_actions: np.ndarray
    ) -> tuple[Tensors, Tensor]:
        """Turn observations and actions of the environment into what the algorithm learns from."""


class OneFileAgent(Agent):
    """A one-file algorithm, which learns from observations as vectors."""

    @property
    def n_critics(self) -> int:
        """Number of columns of ``algorithm.action_values``."""
        if not hasattr(self.algorithm, "action_values"):
            return 0
        observation = torch.zeros(1, self.algorithm.n_observations, device=self.device)
        action = torch.zeros(1, self.algorithm.n_actions, device=self.device)
        return int(self.q_values(observation, action).shape[-1])

    def q_values(self, observations: Tensors, actions: Tensor) -> Tensor:
        """Ask ``algorithm.action_values``."""
        return self.algorithm.action_values(observations, actions)

    def vectors(self, observations: Tensors) -> Tensor:
        """Return the observations themselves."""
        assert isinstance(observations, Tensor)
        return observations

    def as_sampled(
        self, observations: Observation, env_actions: np.ndarray
    ) -> tuple[Tensors, Tensor]:
        """Use the algorithm's own conversions."""
        actions = torch.as_tensor(self.algorithm.from_env_actions(env_actions))
        return self.algorithm.to_vector(observations), actions.to(self.device)


class StableBaselinesAgent(Agent):
    """An off-policy algorithm of Stable-Baselines3 or sb3-contrib."""

    @property
    def n_critics(self) -> int:
        """Number of critics of the policy; a network for discrete actions is none."""
        return getattr(getattr(self.algorithm.policy, "critic", None), "n_critics", 0)

    def q_values(self, observations: Tensors, actions: Tensor) -> Tensor:
        """Ask the policy's critics; TQC's say the mean of their quantiles."""
        critic = self.algorithm.policy.critic
        was_training = critic.training
        critic.set_training_mode(False)  # CrossQ's would change its statistics
        answer = critic(observations, actions)
        critic.set_training_mode(was_training)
        return torch.cat(answer, dim=1) if isinstance(answer, tuple) else answer.mean(dim=2)

    def vectors(self, observations: Tensors) -> Tensor:
        """Join what the replay buffer keeps apart."""
        return to_vector(observations, self.algorithm.observation_space, self.device)

    def as_sampled(
        self, observations: Observation, env_actions: np.ndarray
    ) -> tuple[Tensors, Tensor]:
        """Use the policy's own conversions: the replay buffer holds scaled actions."""
        policy = self.algorithm.policy
        actions = np.asarray(env_actions)
        if not self.has_discrete_actions:
            actions = policy.scale_action(actions).reshape(len(actions), -1)
        return policy.obs_to_tensor(observations)[0], torch.as_tensor(actions, device=self.device)


def make_agent_view(algorithm: Any) -> Agent:
    """Return an algorithm's face for intrinsic rewards."""
    if isinstance(algorithm, OneFileAlgorithm):
        return OneFileAgent(algorithm)
    return StableBaselinesAgent(algorithm)
