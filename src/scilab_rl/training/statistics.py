"""Reward, success and length of training episodes, and what the agent gave itself in them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from scilab_rl.algorithms.inspection import Inspection
from scilab_rl.algorithms.observations import with_terminal_observations
from scilab_rl.envs.observed import StepBatch, success_of
from scilab_rl.metrics.logger import MetricLogger

WINDOW = 100


class RolloutStatistics:
    """Observes training steps and records ``rollout/*`` and ``train/rollout_rewards_step``.

    Rewards are those of the task alone. An intrinsic reward is kept apart, as
    ``rollout/intrinsic_ep_rew_mean`` and ``train/intrinsic_reward_step``.

    Args:
        logger: Where the values are recorded.
        n_envs: Number of training environments.
        on_episode: Called with a dictionary of facts after each episode.
        curious: The algorithm, if it gives itself a reward.
    """

    def __init__(
        self,
        logger: MetricLogger,
        n_envs: int,
        on_episode: Callable[[dict[str, Any]], None],
        curious: Inspection | None = None,
    ) -> None:
        self.logger = logger
        self.on_episode = on_episode
        self.curious = curious
        self.returns = np.zeros(n_envs)
        self.intrinsic_returns = np.zeros(n_envs)
        self.episode_returns: deque[float] = deque(maxlen=WINDOW)
        self.episode_intrinsic_returns: deque[float] = deque(maxlen=WINDOW)
        self.episode_lengths: deque[int] = deque(maxlen=WINDOW)
        self.episode_successes: deque[bool] = deque(maxlen=WINDOW)

    def on_step(self, batch: StepBatch) -> None:
        """Add a step of all environments."""
        self.returns += batch.rewards
        self.logger.record("train/rollout_rewards_step", batch.rewards[0])
        if self.curious is not None:
            self._add_intrinsic_rewards(self.curious, batch)
        for index in np.flatnonzero(batch.dones):
            self._finish(int(index), batch)

    def metrics(self) -> dict[str, float]:
        """Return the means over the last 100 episodes, for those values that exist."""
        windows: dict[str, deque[Any]] = {
            "rollout/ep_rew_mean": self.episode_returns,
            "rollout/intrinsic_ep_rew_mean": self.episode_intrinsic_returns,
            "rollout/ep_len_mean": self.episode_lengths,
            "rollout/success_rate": self.episode_successes,
        }
        return {name: float(np.mean(window)) for name, window in windows.items() if window}

    def _add_intrinsic_rewards(self, curious: Inspection, batch: StepBatch) -> None:
        reached = with_terminal_observations(
            batch.next_observations, batch.dones, list(batch.infos), lambda last: last
        )
        rewards = curious.intrinsic_rewards(batch.observations, batch.actions, reached)
        self.intrinsic_returns += rewards
        self.logger.record("train/intrinsic_reward_step", rewards[0])

    def _finish(self, index: int, batch: StepBatch) -> None:
        episode: dict[str, Any] = {
            "step": batch.step,
            "env": index,
            "episode": int(batch.episodes[index]),
            "reward": float(self.returns[index]),
            "length": int(batch.episode_steps[index]) + 1,
        }
        self.episode_returns.append(episode["reward"])
        self.episode_lengths.append(episode["length"])
        if self.curious is not None:
            episode["intrinsic_reward"] = float(self.intrinsic_returns[index])
            self.episode_intrinsic_returns.append(episode["intrinsic_reward"])
            self.intrinsic_returns[index] = 0.0
        success = success_of(batch.infos[index])
        if success is not None:
            episode["success"] = success
            self.episode_successes.append(success)
        self.returns[index] = 0.0
        self.on_episode(episode)
