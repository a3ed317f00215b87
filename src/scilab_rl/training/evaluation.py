"""The one evaluation loop: used between epochs, at the end, and to play a trained policy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.envs.observed import success_of


@dataclass
class Episode:
    """What happened in one episode.

    Attributes:
        rewards: Reward of each step.
        success: Success at the last step; None when the task has no such notion.
        success_once: Success at any step.
    """

    rewards: list[float] = field(default_factory=list)
    success: bool | None = None
    success_once: bool | None = None

    def add(self, reward: float, info: dict[str, Any]) -> None:
        """Add a step."""
        self.rewards.append(float(reward))
        self.success = success_of(info)
        if self.success is not None:
            self.success_once = bool(self.success_once) or self.success


@dataclass(frozen=True)
class Evaluation:
    """The episodes of one evaluation."""

    episodes: list[Episode]

    def metrics(self, prefix: str = "eval") -> dict[str, float]:
        """Return the means over the episodes, named as Stable-Baselines3 names them."""
        values = {
            "mean_reward": float(np.mean([sum(e.rewards) for e in self.episodes])),
            "mean_ep_length": float(np.mean([len(e.rewards) for e in self.episodes])),
            "rollout_rewards_step": self.episodes[-1].rewards[-1],
        }
        if all(e.success is not None for e in self.episodes):
            values["success_rate"] = float(np.mean([bool(e.success) for e in self.episodes]))
            values["success_once_rate"] = float(
                np.mean([bool(e.success_once) for e in self.episodes])
            )
        return {f"{prefix}/{name}": value for name, value in values.items()}


def evaluate(
    policy: Any,
    env: VecEnv,
    n_episodes: int,
    seed: int,
    *,
    deterministic: bool = True,
    on_episode: Callable[[Episode], None] | None = None,
) -> Evaluation:
    """Let a policy act for some episodes.

    The result is a function of the policy's weights and the seed alone: neither an earlier
    evaluation nor the training environments matter.

    Args:
        policy: Anything with Stable-Baselines3's ``predict``.
        env: A vector environment with one environment.
        n_episodes: How many episodes, at least 1.
        seed: Seed of the first episode; the others follow from it.
        deterministic: Whether the policy's mean action is taken.
        on_episode: Called after each episode.
    """
    env.seed(seed)
    observation = env.reset()
    episodes: list[Episode] = []
    episode, state, starts = Episode(), None, np.ones(1, dtype=bool)
    while len(episodes) < n_episodes:
        action, state = policy.predict(
            observation, state=state, episode_start=starts, deterministic=deterministic
        )
        observation, rewards, starts, infos = env.step(action)
        episode.add(rewards[0], infos[0])
        if starts[0]:
            episodes.append(episode)
            if on_episode is not None:
                on_episode(episode)
            episode = Episode()
    return Evaluation(episodes)


def wilson_interval(successes: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a success rate (Wilson, 1927).

    >>> low, high = wilson_interval(20, 20)
    >>> round(low, 3), high
    (0.839, 1.0)
    """
    rate = successes / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return low, high
