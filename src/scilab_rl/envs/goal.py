"""The base class of goal-conditioned tasks: one's own in one file.

.. code-block:: python

    class ReachOnALine(GoalEnv):
        action_size = 1
        threshold = 0.1

        def reset_state(self) -> None:
            self.place = np.zeros(1)

        def sample_goal(self) -> np.ndarray:
            return self.np_random.uniform(-1, 1, 1)

        def apply_action(self, action: np.ndarray) -> None:
            self.place = self.place + 0.1 * action

        def achieved_goal(self) -> np.ndarray:
            return self.place

        def get_observation(self) -> np.ndarray:
            return self.place

    gymnasium.register("ReachOnALine-v0", entry_point="custom_envs.line:ReachOnALine",
                       max_episode_steps=50)

Spaces, rewards, success, pictures, seeding and pickling follow.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from scilab_rl.envs.goal_drawing import GoalDrawing
from scilab_rl.envs.types import Info
from scilab_rl.errors import ConfigError, did_you_mean

Observation = dict[str, np.ndarray]
RewardFunction = Callable[[np.ndarray, float], np.ndarray]


def sparse_cost(distance: np.ndarray, threshold: float) -> np.ndarray:
    """Return 0 where the goal is reached and -1 elsewhere. Shapes: as ``distance``."""
    return sparse_reward(distance, threshold) - np.float32(1.0)


def sparse_reward(distance: np.ndarray, threshold: float) -> np.ndarray:
    """Return 1 where the goal is reached and 0 elsewhere. Shapes: as ``distance``."""
    return (np.asarray(distance) <= threshold).astype(np.float32)


def negative_distance(distance: np.ndarray, threshold: float) -> np.ndarray:
    """Return minus the distance. Shapes: as ``distance``."""
    return -np.asarray(distance, dtype=np.float32)


def goal_distance(achieved_goal: ArrayLike, desired_goal: ArrayLike) -> np.ndarray:
    """Return the Euclidean distance. Shapes: goals ``(..., goal_size)``; result ``(...)``."""
    return np.linalg.norm(np.asarray(achieved_goal) - np.asarray(desired_goal), axis=-1)


class GoalEnv(gym.Env[Observation, np.ndarray]):
    """A task whose goal is drawn again at each reset and is part of the observation.

    A subclass says five things: `reset_state`, `sample_goal`, `apply_action`, `achieved_goal` and
    `get_observation`. If it has a constructor, that calls ``super().__init__`` **last**, because
    one observation is taken there to learn the shapes.

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
        drawn_range: Range of all axes of the picture; None: what has been seen decides.
        goal: The desired goal of this episode. Shapes: ``(goal_size,)``.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's
    action_size: ClassVar[int]
    threshold: float = 0.05
    rewards: ClassVar[Mapping[str, RewardFunction]] = MappingProxyType(
        {"sparse": sparse_cost, "dense": negative_distance}
    )
    drawn_range: ClassVar[tuple[float, float] | None] = None
    _drawing: GoalDrawing | None = None
    _constructor_arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: object, **kwargs: object) -> GoalEnv:
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
        if render_mode is not None and type(self).render is GoalEnv.render:
            self._drawing = GoalDrawing(self.drawn_range)
        self.action_space = spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)
        self.reset_state()
        self.goal = _as_goal(self.sample_goal())
        self.observation_space: spaces.Dict = spaces.Dict(  # type: ignore[assignment]
            {
                key: spaces.Box(-np.inf, np.inf, entry.shape, np.float32)
                for key, entry in self._observation().items()
            }
        )

    def reset_state(self) -> None:
        """Put the world into a start state; all chance comes from ``self.np_random``."""
        raise NotImplementedError

    def sample_goal(self) -> np.ndarray:
        """Return a new desired goal; called after `reset_state`. Shapes: ``(goal_size,)``."""
        raise NotImplementedError

    def apply_action(self, action: np.ndarray) -> None:
        """Let one step pass in the world.

        Args:
            action: Within [-1, 1]; a copy of the agent's. Shapes: ``(action_size,)``.
        """
        raise NotImplementedError

    def achieved_goal(self) -> np.ndarray:
        """Return what the goal should have been to be reached now. Shapes: ``(goal_size,)``."""
        raise NotImplementedError

    def get_observation(self) -> np.ndarray:
        """Return the state of the world without the goal. Shapes: ``(observation_size,)``."""
        raise NotImplementedError

    def distance(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Return how far goals are apart; Euclidean unless a subclass says otherwise.

        Shapes:
            achieved_goal, desired_goal: ``(..., goal_size)``; result: ``(...)``.
        """
        return goal_distance(achieved_goal, desired_goal)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode with a new goal.

        Args:
            seed: Seeds ``self.np_random``; None keeps its state.
            options: ``{"desired_goal": array}`` sets the goal instead of drawing it.
        """
        super().reset(seed=seed)
        self.reset_state()
        self.goal = _as_goal(self.sample_goal())
        if options and options.get("desired_goal") is not None:
            self.goal = self._given_goal(options["desired_goal"])
        observation = self._observation()
        if self._drawing is not None:
            self._drawing.begin_episode(observation["achieved_goal"])
        return observation, {"is_success": self._is_success(observation)}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, Info]:
        """Act for one step.

        Args:
            action: Clipped to [-1, 1]. Shapes: ``(action_size,)``.

        Returns:
            Observation, reward, whether the goal ended the episode, False (the step limit is a
            wrapper), and ``{"is_success": bool}``.
        """
        self.apply_action(np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0))
        observation = self._observation()
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        if self._drawing is not None:
            self._drawing.add(achieved)
        info = {"is_success": self._is_success(observation)}
        return (
            observation,
            float(self.compute_reward(achieved, desired, info)),
            bool(self.compute_terminated(achieved, desired, info)),
            bool(self.compute_truncated(achieved, desired, info)),
            info,
        )

    def render(self) -> np.ndarray | None:
        """Return a picture of achieved goal, its trail, and desired goal with its threshold.

        A subclass may draw something else.

        Shapes:
            result: ``(480, 480, 3)``, uint8.
        """
        achieved = _as_goal(self.achieved_goal())
        if self._drawing is None:  # a subclass has not passed on its render_mode: without trail
            self._drawing = GoalDrawing(self.drawn_range)
            self._drawing.add(achieved)
        distance = float(self.distance(achieved, self.goal))
        return self._drawing.frame(
            self.goal,
            self.threshold,
            distance,
            reached=distance <= self.threshold,
            is_euclidean=type(self).distance is GoalEnv.distance,
        )

    def compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return the reward for reaching one goal while another was wanted.

        Shapes:
            achieved_goal, desired_goal: ``(..., goal_size)``; result: ``(...)``.
        """
        reward = self.rewards[self.reward_type]
        return reward(self.distance(achieved_goal, desired_goal), self.threshold)

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return whether the episode ends here. Shapes: as in `compute_reward`."""
        reached = self.distance(achieved_goal, desired_goal) <= self.threshold
        return reached & self.terminate_on_success

    def compute_truncated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return False: the step limit is a wrapper's business. Shapes: as `compute_reward`."""
        return np.zeros(np.shape(achieved_goal)[:-1], dtype=bool)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as a new environment with the same arguments; the running episode is lost."""
        args, kwargs = self._constructor_arguments
        return functools.partial(type(self), *args, **kwargs), ()

    def _is_success(self, observation: Observation) -> bool:
        distance = self.distance(observation["achieved_goal"], observation["desired_goal"])
        return bool(distance <= self.threshold)

    def _observation(self) -> Observation:
        # Copies, so that stored observations do not change.
        return {
            "observation": np.array(self.get_observation(), dtype=np.float32),
            "achieved_goal": _as_goal(self.achieved_goal()),
            "desired_goal": self.goal.copy(),
        }

    def _given_goal(self, desired_goal: np.ndarray) -> np.ndarray:
        goal = _as_goal(desired_goal)
        if goal.shape != self.goal.shape:
            raise ConfigError(
                f"The desired goal of {type(self).__name__} has shape {self.goal.shape}, but "
                f"options['desired_goal'] has {goal.shape}."
            )
        return goal


def require_choice(name: str, given: object, allowed: Iterable[object]) -> None:
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


def _as_goal(values: ArrayLike) -> np.ndarray:
    # Rounded to float32 before rewards are computed from it, so that a reward that is recomputed
    # from a replay buffer is the same one.
    return np.array(values, dtype=np.float32)
