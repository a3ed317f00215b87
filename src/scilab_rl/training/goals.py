"""Whether goals can be put in afterwards in a task; checked before the first step of a run."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Collection, Mapping, Sequence

import gymnasium as gym
import numpy as np
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.envs.random_rollout import RandomRollout, random_rollout
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.replay import HindsightReplayBuffer
from scilab_rl.relabeling import (
    INFO_KEYS,
    for_batches,
    info_needs,
    is_number,
    reads_infos,
    refuse_unknown_keys,
)

_log = logging.getLogger(__name__)
_N_STEPS = 40
_SEED = 4321
_WHOLE_INFOS = (
    "algorithm.replay_buffer_class=her ++algorithm.replay_buffer_kwargs.copy_info_dict=true"
)
GoalFunctions = Mapping[str, Callable[..., object]]


def check_relabeling(algorithm: Algorithm, eval_env: VecEnv) -> None:
    """Reject hindsight replay whose rewards or endings could not be computed.

    A task whose functions look at goals alone is not touched. In others, some random steps are
    made in the environment for evaluation, which each evaluation seeds and resets anyway.

    Args:
        algorithm: Built; nothing is checked if it has no hindsight replay buffer.
        eval_env: The environment for evaluation.

    Raises:
        ConfigError: If a function needs something that the buffer does not keep.
    """
    buffer = getattr(algorithm, "replay_buffer", None)
    if not isinstance(buffer, HerReplayBuffer):
        return
    env: gym.Env = eval_env.unwrapped.envs[0]  # type: ignore[attr-defined]
    functions = _functions(env, buffer)
    kept = buffer.info_keys if isinstance(buffer, HindsightReplayBuffer) else ()
    goals = _goals_of_space(env.observation_space)
    if not kept and not any(reads_infos(f, *goals) for f in functions.values()):
        _check_batches(buffer, functions, *goals, [{}] * len(goals[0]))
        return
    steps = _some_steps(env)
    if steps is None:
        return
    refuse_unknown_keys(kept, steps.infos)
    _check_infos(buffer, functions, steps, kept)


def _functions(env: gym.Env, buffer: HerReplayBuffer) -> GoalFunctions:
    """Return the functions of goals that a buffer calls."""
    names = ["compute_reward"]
    if isinstance(buffer, HindsightReplayBuffer):
        names.append("compute_terminated")
    return {n: env.get_wrapper_attr(n) for n in names if env.has_wrapper_attr(n)}


def _goals_of_space(space: gym.Space) -> tuple[np.ndarray, np.ndarray]:
    """Draw goals from their space, without touching its own random numbers."""
    space = copy.deepcopy(space)
    space.seed(_SEED)
    with np.errstate(all="ignore"):
        drawn = [space.sample() for _ in range(4)]
    return tuple(np.array([o[f"{k}_goal"] for o in drawn]) for k in ("achieved", "desired"))  # type: ignore[return-value]


def _some_steps(env: gym.Env) -> RandomRollout | None:
    try:
        return random_rollout(env, _N_STEPS, _SEED)
    except Exception:  # noqa: BLE001 - the run reports a broken environment
        return None


def _check_infos(
    buffer: HerReplayBuffer, functions: GoalFunctions, steps: RandomRollout, kept: Collection[str]
) -> None:
    goals = steps.goals("achieved_goal"), steps.goals("desired_goal")
    for name, function in functions.items():
        try:
            needs = info_needs(function, *goals, steps.infos, kept)
        except NotImplementedError:
            continue
        except Exception as error:
            raise ConfigError(
                f"{name} fails with the goals and infos of the environment's own steps: "
                f"{type(error).__name__}: {error}. Try scilab-rl doctor env=ID."
            ) from error
        _check_batches(buffer, {name: function}, *goals, steps.infos)
        if needs.keys and not getattr(buffer, "copy_info_dict", False):
            _tell_missing(name, needs.keys, needs.is_required, buffer, steps.infos[-1], kept)


def _tell_missing(
    name: str,
    keys: tuple[str, ...],
    is_required: bool,
    buffer: HerReplayBuffer,
    info: Mapping[str, object],
    kept: Collection[str],
) -> None:
    named = ", ".join(f"info['{key}']" for key in keys)
    remedy = f"add ++{INFO_KEYS}=[{','.join([*kept, *keys])}]"
    if not isinstance(buffer, HindsightReplayBuffer):
        remedy = "add ++algorithm.replay_buffer_kwargs.copy_info_dict=true"
    elif not all(is_number(info.get(key, 0)) for key in keys):
        remedy = f"use {_WHOLE_INFOS}"
    problem = f"{name} reads {named}, which the replay buffer does not keep for relabeled goals"
    if is_required:
        raise ConfigError(f"{problem}, and fails without; {remedy}.")
    _log.warning("%s: their rewards or endings may be wrong; %s.", problem, remedy)


def _check_batches(
    buffer: HerReplayBuffer,
    functions: GoalFunctions,
    achieved: np.ndarray,
    desired: np.ndarray,
    infos: Sequence[Mapping[str, object]],
) -> None:
    """Reject what Stable-Baselines3's buffer cannot use: it asks for all goals in one call."""
    if isinstance(buffer, HindsightReplayBuffer):
        return
    for name, function in functions.items():
        answer = for_batches(function, achieved, desired, infos)
        if answer is not function:
            raise ConfigError(
                f"{name} answers for one pair of goals at a time, but Stable-Baselines3's replay "
                "buffer asks for all in one call: compute over axis=-1, or use "
                "algorithm.replay_buffer_class=auto."
            )
