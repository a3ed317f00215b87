"""An environment's ``compute_reward`` and ``compute_terminated``, for many goals in one call."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.errors import ConfigError

# Takes achieved goals, desired goals and one info per pair.
GoalFunction = Callable[[np.ndarray, np.ndarray, Any], np.ndarray]
# Goals this far apart are different ones in every task.
_FAR = 1.0e3


def goal_reward(env: VecEnv, goal_shape: tuple[int, ...], info: Mapping[str, Any]) -> GoalFunction:
    """Return the reward for reaching one goal while another was wanted.

    Args:
        env: Its first environment answers; all are of one kind.
        goal_shape: Of one goal.
        info: What an info holds, for a trial.

    Shapes:
        of the returned function: goals ``(batch, *goal_shape)``; result: ``(batch,)``.

    Raises:
        ConfigError: If the environment has no ``compute_reward``.
    """
    function = _find(env, "compute_reward")
    if function is None:
        raise ConfigError(
            "Hindsight experience replay needs compute_reward(achieved_goal, desired_goal, info), "
            "and this environment has none; add ++algorithm.replay_buffer_class=null."
        )
    return _for_batches(function, goal_shape, info)


def goal_termination(
    env: VecEnv, goal_shape: tuple[int, ...], info: Mapping[str, Any]
) -> GoalFunction | None:
    """Return whether reaching one goal while another was wanted ends the episode.

    Returns:
        None where the environment does not say. Arguments and shapes: as in `goal_reward`.
    """
    function = _find(env, "compute_terminated")
    try:
        return None if function is None else _for_batches(function, goal_shape, info)
    except NotImplementedError:
        return None


def _find(env: VecEnv, name: str) -> Callable[..., Any] | None:
    """Return a method of the first environment, called as directly as possible.

    An environment in another process would have to be asked through its pipe, which takes longer
    than sampling and is not possible while it steps; so a copy of it is asked that lives here.
    """
    if not env.has_attr(name):
        return None
    base = env.unwrapped
    if hasattr(base, "envs"):
        return base.envs[0].get_wrapper_attr(name)
    if env.has_attr("pickled_method"):
        pickled = env.env_method("pickled_method", name, indices=[0])[0]
        if pickled is not None:
            return pickle.loads(pickled)  # written a moment ago by our own process
    return lambda *arguments: env.env_method(name, *arguments, indices=[0])[0]


def _for_batches(
    function: Callable[..., Any], goal_shape: tuple[int, ...], info: Mapping[str, Any]
) -> GoalFunction:
    """Let a function of goals return one value per pair, whatever it was written for.

    Some environments return one constant for all pairs, which is spread over them, and some can
    only answer for a single pair. A trial with two pairs tells which kind this is.
    """
    desired = np.zeros((2, *goal_shape), np.float32)
    achieved = desired.copy()
    achieved[1] = _FAR
    infos = [dict(info), dict(info)]
    together = np.asarray(function(achieved, desired, infos))
    if together.shape == (2,):
        return function
    single = [np.asarray(function(achieved[i], desired[i], infos[i])) for i in range(2)]
    if together.ndim == 0 and all(value == together for value in single):
        return partial(_spread, function)
    return partial(_one_by_one, function)


def _spread(function: Callable[..., Any], achieved: Any, desired: Any, infos: Any) -> np.ndarray:
    return np.broadcast_to(function(achieved, desired, infos), len(achieved))


def _one_by_one(
    function: Callable[..., Any], achieved: Any, desired: Any, infos: Any
) -> np.ndarray:
    pairs = zip(achieved, desired, infos, strict=True)
    return np.array([np.asarray(function(*pair)).item() for pair in pairs])
