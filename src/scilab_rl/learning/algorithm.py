"""The interface of algorithms: ours, Stable-Baselines3's, or a user's own."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs

from scilab_rl.metrics.logger import MetricLogger


class Policy(Protocol):
    """Anything that chooses actions."""

    def predict(
        self,
        observation: VecEnvObs,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions for a batch of observations, and the policy's memory."""


class Algorithm(Policy, Protocol):
    """Anything that learns."""

    num_timesteps: int

    @property
    def observation_space(self) -> spaces.Space:
        """What it reads."""

    @property
    def action_space(self) -> spaces.Space:
        """What it chooses from."""

    def get_env(self) -> VecEnv:
        """Return the environments that it learns in."""

    def set_logger(self, logger: MetricLogger) -> None:
        """Record metrics with this logger."""

    def learn(
        self,
        total_timesteps: int,
        callback: BaseCallback,
        log_interval: int | None = None,
        reset_num_timesteps: bool = True,
    ) -> object:
        """Learn for so many environment steps."""
