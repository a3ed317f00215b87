"""Reward, success and length of training episodes, and what the agent gave itself in them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from scilab_rl.envs.vec_step import ObservedStep
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.success import episode_outcomes, success_metrics, success_of

WINDOW = 100


class RolloutStatistics:
    """Observes training steps and records ``rollout/*`` and ``train/rollout_rewards_step``.

    Rewards are those of the task alone. An intrinsic reward is kept apart, as
    ``rollout/intrinsic_ep_rew_mean`` and ``train/intrinsic_reward_step``.

    Args:
        logger: Where the values are recorded.
        n_envs: Number of training environments.
        on_episode: Called with a dictionary of facts after each episode.
        inspector: The algorithm, if it gives itself a reward.
    """

    def __init__(
        self,
        logger: MetricLogger,
        n_envs: int,
        on_episode: Callable[[dict[str, float]], None],
        inspector: AgentInspector | None = None,
    ) -> None:
        self.logger = logger
        self.on_episode = on_episode
        self.inspector = inspector
        self.returns = np.zeros(n_envs)
        self.intrinsic_returns = np.zeros(n_envs)
        self.episode_returns: deque[float] = deque(maxlen=WINDOW)
        self.episode_intrinsic_returns: deque[float] = deque(maxlen=WINDOW)
        self.episode_lengths: deque[float] = deque(maxlen=WINDOW)
        self.episode_successes: deque[bool | None] = deque(maxlen=WINDOW)

    def on_step(self, step: ObservedStep) -> None:
        """Add a step of all environments."""
        self.returns += step.rewards
        self.logger.record("train/rollout_rewards_step", step.rewards[0])
        if self.inspector is not None:
            self._add_intrinsic_rewards(self.inspector, step)
        for index in np.flatnonzero(step.dones):
            self._finish(int(index), step)

    @property
    def reports_success(self) -> bool:
        """Whether any of the last episodes reported success or failure at its end."""
        return any(success is not None for success in self.episode_successes)

    def metrics(self, *, reports_success: bool = False) -> dict[str, float]:
        """Return the means over the last 100 episodes, for those values that exist.

        Args:
            reports_success: Whether the task is known to report success, from other episodes.
        """
        windows: dict[str, deque[float]] = {
            "rollout/ep_rew_mean": self.episode_returns,
            "rollout/intrinsic_ep_rew_mean": self.episode_intrinsic_returns,
            "rollout/ep_len_mean": self.episode_lengths,
        }
        values = {name: float(np.mean(window)) for name, window in windows.items() if window}
        reported = list(self.episode_successes)
        outcomes = episode_outcomes(reported, reports_success=reports_success)
        if outcomes:
            rates = success_metrics(outcomes, reported)
            values |= {f"rollout/{name}": value for name, value in rates.items()}
        return values

    def _add_intrinsic_rewards(self, inspector: AgentInspector, step: ObservedStep) -> None:
        rewards = inspector.intrinsic_rewards(
            step.observations, step.actions, step.next_observations
        )
        self.intrinsic_returns += rewards
        self.logger.record("train/intrinsic_reward_step", rewards[0])

    def _finish(self, index: int, step: ObservedStep) -> None:
        episode: dict[str, float] = {
            "step": step.step,
            "env": index,
            "episode": int(step.episodes[index]),
            "reward": float(self.returns[index]),
            "length": int(step.episode_steps[index]) + 1,
        }
        self.episode_returns.append(episode["reward"])
        self.episode_lengths.append(episode["length"])
        if self.inspector is not None:
            episode["intrinsic_reward"] = float(self.intrinsic_returns[index])
            self.episode_intrinsic_returns.append(episode["intrinsic_reward"])
            self.intrinsic_returns[index] = 0.0
        success = success_of(step.infos[index])
        self.episode_successes.append(success)
        if success is not None:
            episode["success"] = success
        self.returns[index] = 0.0
        self.on_episode(episode)
