"""Where episodes began and ended: an observer of steps for evaluations."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.envs.vec_step import ObservedStep
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.learning.observations import single


class EpisodeGoals:
    """Collects first observations and last goals of episodes, in order, for each environment.

    Args:
        env: The environments; nothing is collected where observations have no goals.

    Attributes:
        first: First observation of each episode that has ended.
        desired: Desired goal at its end. Shapes: ``(*goal_shape)`` each.
        achieved: Achieved goal at its end. Shapes: ``(*goal_shape)`` each.
    """

    def __init__(self, env: VecEnv) -> None:
        self.first: list[list[dict[str, np.ndarray]]] = [[] for _ in range(env.num_envs)]
        self.desired: list[list[np.ndarray]] = [[] for _ in range(env.num_envs)]
        self.achieved: list[list[np.ndarray]] = [[] for _ in range(env.num_envs)]
        self._begun: dict[int, dict[str, np.ndarray]] = {}
        observed_layer(env).observers.append(self)

    def on_step(self, step: ObservedStep) -> None:
        """Look at a step."""
        last = step.next_observations
        if not isinstance(last, dict) or "desired_goal" not in last:
            return
        for index in np.flatnonzero(step.episode_steps == 0).tolist():
            self._begun[index] = single(step.observations, index)  # type: ignore[assignment]
        for index in np.flatnonzero(step.dones).tolist():
            self.first[index].append(self._begun.pop(index))
            self.desired[index].append(last["desired_goal"][index].copy())
            self.achieved[index].append(last["achieved_goal"][index].copy())
