"""A random policy's steps, recorded in full, for the doctor to look at."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.envs.fingerprint import scripted_action
from scilab_rl.envs.types import Info
from scilab_rl.metrics.success import episode_outcomes, success_of


@dataclass
class RandomRollout:
    """Everything that happened in a number of steps.

    Attributes:
        observations: After each step. Shapes: ``n_steps`` entries.
        rewards: Shapes: ``(n_steps,)``.
        terminated: Shapes: ``(n_steps,)``.
        truncated: Shapes: ``(n_steps,)``.
        infos: One dictionary per step.
        first_observations: One per episode.
        first_successes: Whether the goal was reached at the reset; only where info says so.
        lengths: Steps of each finished episode.
        final_reported: Success that each finished episode reported at its end; None: nothing.
        step_seconds: Wall time of all steps.
        reset_seconds: Wall time of all resets.
    """

    observations: list[Any] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: list[bool] = field(default_factory=list)
    truncated: list[bool] = field(default_factory=list)
    infos: list[Info] = field(default_factory=list)
    first_observations: list[Any] = field(default_factory=list)
    first_successes: list[bool] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    final_reported: list[bool | None] = field(default_factory=list)
    step_seconds: float = 0.0
    reset_seconds: float = 0.0

    @property
    def successes(self) -> list[bool | None]:
        """Success at each step; None where the task has no such notion."""
        return [success_of(info) for info in self.infos]

    @property
    def outcomes(self) -> list[bool] | None:
        """Which finished episodes succeeded; None where no step of any reported success."""
        reports = any(success is not None for success in self.successes)
        return episode_outcomes(self.final_reported, reports_success=reports)

    def goals(self, key: str) -> np.ndarray:
        """Return all achieved or desired goals. Shapes: ``(n_steps, goal_size)``."""
        return np.array([observation[key] for observation in self.observations])


def random_rollout(env: gym.Env, n_steps: int, seed: int) -> RandomRollout:
    """Act at random for a number of steps, over as many episodes as that takes.

    Args:
        env: With its step limit.
        n_steps: How many.
        seed: Of the environment and of the actions.
    """
    rollout, rng = RandomRollout(), np.random.default_rng(seed)
    _reset(env, rollout, seed)
    length = 0
    for _ in range(n_steps):
        action = scripted_action(env.action_space, rng)
        started = time.perf_counter()
        observation, reward, terminated, truncated, info = env.step(action)
        rollout.step_seconds += time.perf_counter() - started
        rollout.observations.append(observation)
        rollout.rewards.append(float(reward))
        rollout.terminated.append(bool(terminated))
        rollout.truncated.append(bool(truncated))
        rollout.infos.append(info)
        length += 1
        if terminated or truncated:
            rollout.lengths.append(length)
            rollout.final_reported.append(success_of(info))
            _reset(env, rollout)
            length = 0
    return rollout


def _reset(env: gym.Env, rollout: RandomRollout, seed: int | None = None) -> None:
    started = time.perf_counter()
    observation, info = env.reset(seed=seed)
    rollout.reset_seconds += time.perf_counter() - started
    rollout.first_observations.append(observation)
    success = success_at(env, observation, info)
    if success is not None:
        rollout.first_successes.append(success)


def success_at(env: gym.Env, observation: Any, info: Info) -> bool | None:
    """Return whether the goal is reached already, as the info, or else the reward, tells it.

    Args:
        env: The environment.
        observation: Of a reset.
        info: Of a reset; many environments say nothing there.
    """
    success = success_of(info)
    if success is not None or not env.has_wrapper_attr("compute_reward"):
        return success
    reward = env.get_wrapper_attr("compute_reward")
    achieved, desired = observation["achieved_goal"], observation["desired_goal"]
    try:
        return bool(reward(achieved, desired, info) >= reward(achieved, achieved, info))
    except KeyError:  # it reads what only the infos of steps have
        return None
