"""The base class of goal-conditioned tasks: one's own in one file.

.. code-block:: python

    class ReachOnALine(GoalEnv):
        action_size = 1
        threshold = 0.1

        def restart(self) -> None:
            self.place = np.zeros(1)

        def sample_goal(self) -> np.ndarray:
            return self.np_random.uniform(-1, 1, 1)

        def apply(self, action: np.ndarray) -> None:
            self.place = self.place + 0.1 * action

        def achieved_goal(self) -> np.ndarray:
            return self.place

        def observe(self) -> np.ndarray:
            return self.place

    gymnasium.register("ReachOnALine-v0", entry_point="custom_envs.line:ReachOnALine",
                       max_episode_steps=50)

Spaces, rewards, success, seeding and pickling follow.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.errors import ConfigError, did_you_mean

Observation = dict[str, np.ndarray]
RewardFunction = Callable[[Any, float], Any]


def cost_per_step(distance: Any, threshold: float) -> Any:
    """Return 0 where the goal is reached and -1 elsewhere. Shapes: as ``distance``."""
    return pay_at_goal(distance, threshold) - np.float32(1.0)


def pay_at_goal(distance: Any, threshold: float) -> Any:
    """Return 1 where the goal is reached and 0 elsewhere. Shapes: as ``distance``."""
    return (np.asarray(distance) <= threshold).astype(np.float32)


def minus_distance(distance: Any, threshold: float) -> Any:
    """Return minus the distance. Shapes: as ``distance``."""
    return -np.asarray(distance, dtype=np.float32)


class GoalEnv(gym.Env[Observation, np.ndarray]):
    """A task whose goal is drawn anew at each reset and is part of the observation.

    A subclass says five things: `restart`, `sample_goal`, `apply`, `achieved_goal` and `observe`.
    If it has a constructor, that calls ``super().__init__`` **last**, because one observation is
    taken there to learn the shapes.

    The keys of observations are ``observation``, ``achieved_goal`` and ``desired_goal``, all
    float32, and ``info["is_success"]`` tells whether the goal is reached at this step.

    Args:
        reward_type: A name in the class attribute `rewards`; None means the first.
        threshold: Distance up to which the goal counts as reached; None means the class's.
        terminate_on_success: Whether reaching the goal ends the episode.
        render_mode: None, or one of ``metadata["render_modes"]``.

    Attributes:
        action_size: Number of action dimensions, each in [-1, 1].
        rewards: Name to function of distance and threshold.
        goal: The desired goal of this episode. Shapes: ``(goal_size,)``.
    """

    action_size: ClassVar[int]
    threshold: float = 0.05
    rewards: ClassVar[Mapping[str, RewardFunction]] = MappingProxyType(
        {"sparse": cost_per_step, "dense": minus_distance}
    )
    _constructor_arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> GoalEnv:
        """Remember the arguments, so that every subclass can be pickled."""
        self = super().__new__(cls)
        self._constructor_arguments = args, kwargs
        return self

    def __init__(
        self,
        *,
        reward_type: str | None = None,
        threshold: float | None = None,
        terminate_on_success: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self.reward_type = next(iter(self.rewards)) if reward_type is None else reward_type
        require_choice("reward_type", self.reward_type, self.rewards)
        if threshold is not None:
            self.threshold = float(threshold)
        self.terminate_on_success = terminate_on_success
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)
        self.restart()
        self.goal = _as_goal(self.sample_goal())
        self.observation_space: spaces.Dict = spaces.Dict(  # type: ignore[assignment]
            {
                key: spaces.Box(-np.inf, np.inf, entry.shape, np.float32)
                for key, entry in self._observation().items()
            }
        )

    def restart(self) -> None:
        """Put the world into a start state; all chance comes from ``self.np_random``."""
        raise NotImplementedError

    def sample_goal(self) -> np.ndarray:
        """Return a new desired goal; called after `restart`. Shapes: ``(goal_size,)``."""
        raise NotImplementedError

    def apply(self, action: np.ndarray) -> None:
        """Let one step pass in the world.

        Args:
            action: Within [-1, 1]; a copy of the agent's. Shapes: ``(action_size,)``.
        """
        raise NotImplementedError

    def achieved_goal(self) -> np.ndarray:
        """Return what the goal should have been to be reached now. Shapes: ``(goal_size,)``."""
        raise NotImplementedError

    def observe(self) -> np.ndarray:
        """Return the state of the world without the goal. Shapes: ``(observation_size,)``."""
        raise NotImplementedError

    def distance(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> Any:
        """Return how far goals are apart; Euclidean unless a subclass says otherwise.

        Shapes:
            achieved_goal, desired_goal: ``(..., goal_size)``; result: ``(...)``.
        """
        return np.linalg.norm(np.asarray(achieved_goal) - np.asarray(desired_goal), axis=-1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode with a new goal.

        Args:
            seed: Seeds ``self.np_random``; None goes on with it.
            options: ``{"desired_goal": array}`` sets the goal instead of drawing it.
        """
        super().reset(seed=seed)
        self.restart()
        self.goal = _as_goal(self.sample_goal())
        if options and options.get("desired_goal") is not None:
            self.goal = self._given_goal(options["desired_goal"])
        observation = self._observation()
        return observation, {"is_success": self._is_success(observation)}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one step.

        Args:
            action: Clipped to [-1, 1]. Shapes: ``(action_size,)``.

        Returns:
            Observation, reward, whether the goal ended the episode, False (the step limit is a
            wrapper), and ``{"is_success": bool}``.
        """
        self.apply(np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0))
        observation = self._observation()
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        info = {"is_success": self._is_success(observation)}
        return (
            observation,
            float(self.compute_reward(achieved, desired, info)),
            bool(self.compute_terminated(achieved, desired, info)),
            bool(self.compute_truncated(achieved, desired, info)),
            info,
        )

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Return the reward for reaching one goal while another was wanted.

        Shapes:
            achieved_goal, desired_goal: ``(..., goal_size)``; result: ``(...)``.
        """
        reward = self.rewards[self.reward_type]
        return reward(self.distance(achieved_goal, desired_goal), self.threshold)

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Return whether the episode ends here. Shapes: as in `compute_reward`."""
        reached = self.distance(achieved_goal, desired_goal) <= self.threshold
        return reached & self.terminate_on_success

    def compute_truncated(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Return False: the step limit is a wrapper's business. Shapes: as `compute_reward`."""
        return np.zeros(np.shape(achieved_goal)[:-1], dtype=bool)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as a new environment with the same arguments; the running episode is lost."""
        args, kwargs = self._constructor_arguments
        return functools.partial(type(self), *args, **kwargs), ()

    def _is_success(self, observation: Observation) -> bool:
        distance = self.distance(observation["achieved_goal"], observation["desired_goal"])
        return bool(distance <= self.threshold)

    def _observation(self) -> Observation:
        # Copies, so that nobody who keeps an observation sees it move.
        return {
            "observation": np.array(self.observe(), dtype=np.float32),
            "achieved_goal": _as_goal(self.achieved_goal()),
            "desired_goal": self.goal.copy(),
        }

    def _given_goal(self, desired_goal: Any) -> np.ndarray:
        goal = _as_goal(desired_goal)
        if goal.shape != self.goal.shape:
            raise ConfigError(
                f"The desired goal of {type(self).__name__} has shape {self.goal.shape}, but "
                f"options['desired_goal'] has {goal.shape}."
            )
        return goal


def require_choice(name: str, given: Any, allowed: Any) -> None:
    """Refuse a keyword argument that is none of the allowed words.

    Raises:
        ConfigError: Naming the argument and what it can be.
    """
    if given not in allowed:
        words = [str(word) for word in allowed]
        raise ConfigError(
            f"env_kwargs.{name} must be one of {', '.join(words)}, but it is {given!r}."
            f"{did_you_mean(str(given), words)}"
        )


def _as_goal(values: Any) -> np.ndarray:
    # Rounded to float32 before rewards are computed from it, so that a reward that is recomputed
    # from a replay buffer is the same one.
    return np.array(values, dtype=np.float32)
