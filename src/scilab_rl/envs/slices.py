"""A goal task out of any environment whose observation vector holds a place and a target.

.. code-block:: yaml

    wrappers:
      - _target_: scilab_rl.envs.slices.GoalFromSlices
        achieved: [4, 7]  # from, to
        desired: [36, 39]
        threshold: 0.07
"""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.envs.goal import goal_distance, negative_distance, require_choice, sparse_cost
from scilab_rl.envs.types import Info, ResetResult, StepResult
from scilab_rl.errors import ConfigError

_REWARDS = {"sparse": sparse_cost, "dense": negative_distance}


class GoalFromSlices(gym.Wrapper):
    """Turns a vector observation into one with achieved and desired goal.

    The reward becomes that of the goal; the environment's own is kept as ``info["own_reward"]``.

    Args:
        env: An environment with a Box observation of one dimension.
        achieved: Where the achieved goal begins and ends in the observation.
        desired: The same for the desired goal.
        threshold: Distance up to which the goal counts as reached.
        reward_type: ``sparse`` (0 at the goal, else -1) or ``dense`` (minus the distance).
        terminate_on_success: Whether reaching the goal ends the episode.

    Raises:
        ConfigError: If the slices do not fit the observation.
    """

    def __init__(
        self,
        env: gym.Env,
        achieved: Sequence[int],
        desired: Sequence[int],
        threshold: float,
        reward_type: str = "sparse",
        terminate_on_success: bool = False,
    ) -> None:
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ConfigError(f"GoalFromSlices needs a vector observation, but {env} has {space}.")
        require_choice("reward_type", reward_type, _REWARDS)
        self._achieved = _checked_slice("achieved", achieved, space.shape[0])
        self._desired = _checked_slice("desired", desired, space.shape[0])
        size = self._achieved.stop - self._achieved.start
        if self._desired.stop - self._desired.start != size:
            raise ConfigError(f"achieved {achieved} and desired {desired} differ in length.")
        self.threshold = threshold
        self._reward = _REWARDS[reward_type]
        self._terminate_on_success = terminate_on_success
        goal = spaces.Box(-np.inf, np.inf, (size,), space.dtype)
        self.observation_space = spaces.Dict(
            {"observation": space, "achieved_goal": goal, "desired_goal": goal}
        )

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin an episode."""
        vector, info = self.env.reset(seed=seed, options=options)
        observation = self._split(vector)
        return observation, {**info, "is_success": self._reached(observation)}

    def step(self, action: np.ndarray) -> StepResult:
        """Act; reward and success are those of the goal."""
        vector, own_reward, terminated, truncated, info = self.env.step(action)
        observation = self._split(vector)
        goals = observation["achieved_goal"], observation["desired_goal"]
        info = {**info, "is_success": self._reached(observation), "own_reward": own_reward}
        terminated = terminated or bool(self.compute_terminated(*goals, info))
        reward = float(self.compute_reward(*goals, info))
        return observation, reward, terminated, truncated, info

    def compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return the reward. Shapes: goals ``(..., goal_size)``, result ``(...)``."""
        return self._reward(goal_distance(achieved_goal, desired_goal), self.threshold)

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return whether the goal ends the episode. Shapes: as `compute_reward`."""
        reached = goal_distance(achieved_goal, desired_goal) <= self.threshold
        return reached & self._terminate_on_success

    def _split(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        return {
            "observation": vector,
            "achieved_goal": vector[self._achieved].copy(),
            "desired_goal": vector[self._desired].copy(),
        }

    def _reached(self, observation: dict[str, np.ndarray]) -> bool:
        distance = goal_distance(observation["achieved_goal"], observation["desired_goal"])
        return bool(distance <= self.threshold)


def _checked_slice(name: str, given: Sequence[int], size: int) -> slice:
    """Return ``[from, to]`` as a slice of a vector.

    Raises:
        ConfigError: If it reaches beyond the vector or is empty.
    """
    ends = tuple(given)
    if len(ends) != 2 or not 0 <= ends[0] < ends[1] <= size:
        raise ConfigError(
            f"{name} must be [from, to] with 0 <= from < to <= {size}, the length of the "
            f"observation, but it is {list(ends)}."
        )
    return slice(*ends)
