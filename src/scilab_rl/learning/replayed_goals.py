"""The goals that a replay buffer holds, and those that it puts in when it is sampled."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.envs.vec_step import ObservedStep
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.replay import HindsightReplayBuffer

N_SAMPLES = 20_000


@dataclass(frozen=True)
class ReplayedGoals:
    """Goals of transitions that a replay buffer has drawn.

    Attributes:
        desired: The goals that episodes were asked for. Shapes: ``(n, goal_size)``.
        achieved: Where the transitions led. Shapes: ``(n, goal_size)``.
        relabeled: The goals that hindsight puts in.  Shapes: ``(n, goal_size)``; nothing without.
        share: Share of transitions that are relabeled.
        origin: Whose transitions these are, as a sentence.
    """

    desired: np.ndarray
    achieved: np.ndarray
    relabeled: np.ndarray
    share: float
    origin: str


class BufferFiller:
    """Puts each step of an evaluation into a replay buffer: an observer of steps.

    It is the buffer that the algorithm learns from or, where that has no hindsight, one of our own.

    Args:
        algorithm: The algorithm; its environments are those that are observed.
        n_steps: At least so many steps are kept.

    Attributes:
        buffer: The buffer.
        is_own: Whether the buffer is as the algorithm's configuration says.
    """

    def __init__(self, algorithm: Algorithm, n_steps: int) -> None:
        env: VecEnv = algorithm.get_env()
        own = getattr(algorithm, "replay_buffer", None)
        self.is_own = isinstance(own, HerReplayBuffer) and own.n_envs == env.num_envs
        self.buffer: Any = own
        if not self.is_own:
            space: Any = algorithm.observation_space
            self.buffer = HindsightReplayBuffer(
                n_steps, space, algorithm.action_space, env, n_envs=env.num_envs, seed=0
            )
        observed_layer(env).observers.append(self)

    def on_step(self, step: ObservedStep) -> None:
        """Keep a step."""
        self.buffer.add(
            step.observations, step.next_observations, step.actions, step.rewards, step.dones,
            step.infos,
        )  # fmt: skip


def replayed_goals(buffer: HerReplayBuffer, origin: str, n: int = N_SAMPLES) -> ReplayedGoals:
    """Draw transitions from a buffer, once without and once with relabeling.

    Args:
        buffer: With at least one episode.
        origin: Whose transitions it holds, as a sentence.
        n: How many are drawn each time.
    """
    share = float(buffer.her_ratio)
    with _relabeling(buffer, 0.0):
        batch = buffer.sample(n)
    desired, achieved = batch.observations["desired_goal"], batch.next_observations["achieved_goal"]
    relabeled = desired[:0]
    if share > 0:
        with _relabeling(buffer, 1.0):
            relabeled = buffer.sample(n).observations["desired_goal"]
    return ReplayedGoals(_rows(desired), _rows(achieved), _rows(relabeled), share, origin)


def _rows(goals: torch.Tensor) -> np.ndarray:
    return goals.cpu().numpy().reshape(len(goals), -1)


@contextlib.contextmanager
def _relabeling(buffer: Any, share: float) -> Iterator[None]:
    """Relabel this share of transitions, all of the task's goal."""
    original, relay = buffer.her_ratio, getattr(buffer, "relay", None)
    buffer.her_ratio, buffer.relay = share, None
    try:
        yield
    finally:
        buffer.her_ratio, buffer.relay = original, relay
