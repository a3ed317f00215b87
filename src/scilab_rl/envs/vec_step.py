"""A step of a vector of environments, and the one place where the ends of episodes are decoded.

Stable-Baselines3 resets an environment within the step that ends its episode. What its ``step``
returns is then the first observation of the next episode, the last one of the ended episode is in
the info, and so is whether that episode terminated or was only truncated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scilab_rl.envs.types import Info, Observation


@dataclass(frozen=True)
class VecStep:
    """One step of all environments of a vector environment; nobody changes its arrays.

    Attributes:
        observations: What the agent saw before it acted. Shapes: ``(n_envs, ...)`` per entry.
        actions: What it did. Shapes: ``(n_envs, ...)``.
        rewards: Shapes: ``(n_envs,)``.
        terminated: Whether the episode ended in a terminal state, which has no future. Shapes:
            ``(n_envs,)``.
        truncated: Whether it was only cut off, so that the value of the next state still counts.
            Shapes: ``(n_envs,)``.
        infos: One dictionary per environment.
        next_observations: Where the step led; at an episode's end its last observation. Shapes:
            ``(n_envs, ...)`` per entry.
        reset_observations: What the agent acts on next; after an episode's end the first
            observation of the next episode, else the next observation. Shapes: ``(n_envs, ...)``
            per entry.
    """

    observations: Observation
    actions: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    infos: list[Info]
    next_observations: Observation
    reset_observations: Observation

    @property
    def dones(self) -> np.ndarray:
        """Whether the episode ended, for whatever reason. Shapes: ``(n_envs,)``."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class ObservedStep(VecStep):
    """A step as the environments took it, with unscaled rewards, its place and its scene.

    Attributes:
        phase: ``train`` or ``eval``.
        step: Steps so far over all environments, this one included.
        episodes: Number of the running episode per environment, from 0. Shapes: ``(n_envs,)``.
        episode_steps: Index of this step in its episode, from 0. Shapes: ``(n_envs,)``.
        frames: The scene after this step, for environments that capture frames; text says why it
            could not be drawn.
        states: The simulator's state in that scene, where there is one.
    """

    phase: str
    step: int
    episodes: np.ndarray
    episode_steps: np.ndarray
    frames: Sequence[np.ndarray | str | None]
    states: Sequence[np.ndarray | None]


def decode_step(
    observations: Observation,
    actions: np.ndarray,
    new_observations: Observation,
    rewards: np.ndarray,
    dones: np.ndarray,
    infos: list[Info],
) -> VecStep:
    """Return a step from what ``step`` of a vector environment of Stable-Baselines3 has returned.

    Args:
        observations: What the agent acted on.
        actions: What it did.
        new_observations: What was returned, as well as the rest.
        rewards: Shapes: ``(n_envs,)``.
        dones: Shapes: ``(n_envs,)``.
        infos: One dictionary per environment.
    """
    terminated, truncated = decode_dones(dones, infos)
    last = new_observations
    if dones.any():
        last = _copy(new_observations)
        for index in np.flatnonzero(dones).tolist():
            _put(last, index, infos[index]["terminal_observation"])
    return VecStep(
        observations, actions, rewards, terminated, truncated, infos, last, new_observations
    )


def decode_dones(dones: np.ndarray, infos: Sequence[Info]) -> tuple[np.ndarray, np.ndarray]:
    """Return which episodes have terminated and which were truncated.

    Shapes:
        dones, results: ``(n_envs,)``, of truth values.
    """
    truncated = np.zeros(len(dones), bool)
    for index in np.flatnonzero(dones).tolist():
        truncated[index] = infos[index].get("TimeLimit.truncated", False)
    return dones & ~truncated, truncated


def at_ends(dones: np.ndarray, last: Observation, first: Observation) -> Observation:
    """Return ``last`` where an episode ended, and ``first`` elsewhere."""
    if isinstance(first, dict) and isinstance(last, dict):
        return {key: _merged(dones, last[key], entry) for key, entry in first.items()}
    return _merged(dones, np.asarray(last), np.asarray(first))


def _merged(dones: np.ndarray, last: np.ndarray, first: np.ndarray) -> np.ndarray:
    merged = first.copy()
    merged[dones] = last[dones]
    return merged


def _copy(observations: Observation) -> Observation:
    if isinstance(observations, dict):
        return {key: entry.copy() for key, entry in observations.items()}
    return observations.copy()


def _put(observations: Observation, index: int, value: Any) -> None:
    if isinstance(observations, dict):
        for key, entry in observations.items():
            entry[index] = value[key]
    else:
        observations[index] = value
