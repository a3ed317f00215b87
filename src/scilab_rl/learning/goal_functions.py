"""An environment's ``compute_reward`` and ``compute_terminated``, for many goals in one call."""

from __future__ import annotations

import pickle

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.errors import ConfigError
from scilab_rl.relabeling import (
    INFO_KEYS,
    GoalFunction,
    Infos,
    TaskFunction,
    for_batches,
    one_by_one,
)


class RelabelingFunction:
    """A function of goals that is asked for batches.

    Whether it answers a whole batch in one call is found out in its first batch, whose goals and
    infos are those of the task. It must have been found before the environments step, though: its
    environment may be in another process.

    Args:
        name: For messages.
        function: Takes achieved goals, desired goals and infos.

    Shapes:
        goals: ``(batch, *goal_shape)``; result: ``(batch,)``.
    """

    def __init__(self, name: str, function: TaskFunction) -> None:
        self.name = name
        self.function = function
        self._answer: GoalFunction | None = None

    def __call__(self, achieved: np.ndarray, desired: np.ndarray, infos: Infos) -> np.ndarray:
        """Return one value per pair.

        Raises:
            ConfigError: If the function fails for them.
            NotImplementedError: If the environment does not say.
        """
        if self._answer is not None:
            return self._answer(achieved, desired, infos)
        try:
            if len(achieved) < 2:
                return one_by_one(self.function, achieved, desired, infos)
            self._answer = for_batches(self.function, achieved, desired, infos)
            return self._answer(achieved, desired, infos)
        except NotImplementedError:
            raise
        except Exception as error:
            raise ConfigError(
                f"{self.name} fails for relabelled goals: {type(error).__name__}: {error}. What it "
                f"reads from the infos of steps must be named in {INFO_KEYS}."
            ) from error


def goal_reward(env: VecEnv) -> RelabelingFunction:
    """Return the reward for reaching one goal while another was wanted.

    Args:
        env: Its first environment answers; all are of one kind.

    Raises:
        ConfigError: If the environment has no ``compute_reward``.
    """
    function = _find(env, "compute_reward")
    if function is None:
        raise ConfigError(
            "Hindsight experience replay needs compute_reward(achieved_goal, desired_goal, info), "
            "and this environment has none; add ++algorithm.replay_buffer_class=null."
        )
    return RelabelingFunction("compute_reward", function)


def goal_termination(env: VecEnv) -> RelabelingFunction | None:
    """Return whether reaching one goal while another was wanted ends the episode.

    Returns:
        None where the environment has no ``compute_terminated``.
    """
    function = _find(env, "compute_terminated")
    return None if function is None else RelabelingFunction("compute_terminated", function)


def _find(env: VecEnv, name: str) -> TaskFunction | None:
    """Return a method of the first environment, called as directly as possible.

    An environment in another process would have to be asked through its pipe, which takes longer
    than sampling and is not possible while it steps; so a copy of it is asked that lives here.
    """
    if not env.has_attr(name):
        return None
    base = env.unwrapped
    if hasattr(base, "envs"):
        return _with_own_arrays(base.envs[0].get_wrapper_attr(name))
    if env.has_attr("pickled_method"):
        pickled = env.env_method("pickled_method", name, indices=[0])[0]
        if pickled is not None:
            own = pickle.loads(pickled)  # written a moment ago by our own process
            return _with_own_arrays(own)
    return lambda *arguments: env.env_method(name, *arguments, indices=[0])[0]


def _with_own_arrays(function: TaskFunction) -> TaskFunction:
    """Give copies of the goals, which the environment may change, to a function of it."""
    return lambda *arguments: function(
        *(value.copy() if isinstance(value, np.ndarray) else value for value in arguments)
    )
