"""From an algorithm's configuration to an object that can learn."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.algorithms.intrinsic.build import attach_intrinsic_reward, with_intrinsic_reward
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.arguments import DEMOS, INTRINSIC, accepts
from scilab_rl.learning.compatibility import is_goal_space, is_large_image, longest_episode
from scilab_rl.learning.replay import HindsightReplayBuffer, can_hold
from scilab_rl.learning.values import constructor_parameters

_log = logging.getLogger(__name__)


def build_algorithm(
    cls: Callable[..., Algorithm],
    arguments: Mapping[str, object],
    env: VecEnv,
    *,
    seed: int,
    device: str,
) -> Algorithm:
    """Build an algorithm with what follows from the environment filled in.

    ``policy: auto`` becomes the policy class for the observations, ``replay_buffer_class: auto``
    hindsight experience replay for goal environments (``her`` is Stable-Baselines3's), and a scalar
    action noise gets the shape of the actions.

    Args:
        cls: The class that ``_target_`` names.
        arguments: Its keyword arguments from the configuration.
        env: Training environments.
        seed: Seed of the run.
        device: ``auto``, ``cpu``, ``cuda``, ...

    Raises:
        ConfigError: If hindsight replay cannot work with this environment, or the constructor
            refuses the arguments.
    """
    arguments = dict(arguments)
    if accepts(cls, "policy") and arguments.get("policy", "auto") == "auto":
        arguments["policy"] = policy_name(env, cls)
    if "replay_buffer_class" in arguments:
        _choose_replay_buffer(cls, arguments, env)
    if isinstance(noise := arguments.get("action_noise"), ActionNoise):
        arguments["action_noise"] = _shaped_noise(noise, env)
    given = {"env": env, "seed": seed, "device": device}
    arguments |= {name: value for name, value in given.items() if accepts(cls, name)}
    if not accepts(cls, DEMOS):
        arguments.pop(DEMOS, None)  # the run puts them into the replay buffer
    intrinsic: Any = None if accepts(cls, INTRINSIC) else arguments.pop(INTRINSIC, None)
    if intrinsic is not None:
        arguments["replay_buffer_class"] = _intrinsic_reward_buffer(arguments, env)
    try:
        algorithm = cls(**arguments)
    except (AssertionError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{getattr(cls, '__name__', cls)} rejects its arguments: {error}"
        ) from error
    if intrinsic is not None:
        attach_intrinsic_reward(algorithm, intrinsic)
    return algorithm


def policy_name(env: VecEnv, cls: object) -> str:
    """Return an algorithm's name of the policy that reads these observations."""
    kind = "Cnn" if is_large_image(env.observation_space) else "Mlp"
    if hasattr(env.observation_space, "spaces"):
        kind = "MultiInput"
    recurrent = f"{kind}LstmPolicy"
    return recurrent if recurrent in getattr(cls, "policy_aliases", ()) else f"{kind}Policy"


def _choose_replay_buffer(
    cls: Callable[..., Algorithm], arguments: dict[str, Any], env: VecEnv
) -> None:
    chosen, has_goals = arguments["replay_buffer_class"], is_goal_space(env.observation_space)
    if chosen == "auto":
        ours = HindsightReplayBuffer if can_hold(env.observation_space) else HerReplayBuffer
        chosen = ours if has_goals else None
    elif chosen == "her":
        chosen = HerReplayBuffer
    arguments["replay_buffer_class"] = chosen
    if chosen is None or not issubclass(chosen, HerReplayBuffer):
        arguments["replay_buffer_kwargs"] = None
        return
    if not has_goals:
        raise ConfigError(
            "Hindsight experience replay needs an environment with goals (Dict observations with "
            "observation, achieved_goal, desired_goal); add ++algorithm.replay_buffer_class=null."
        )
    arguments["learning_starts"] = _first_update(cls, arguments, env)


def _intrinsic_reward_buffer(arguments: dict[str, Any], env: VecEnv) -> type[ReplayBuffer]:
    """Return the chosen kind of replay buffer, with the intrinsic reward in its samples."""
    if arguments.get("n_steps", 1) > 1:
        raise ConfigError(
            "An intrinsic reward belongs to single steps; use it with algorithm.n_steps=1, not "
            f"{arguments['n_steps']}."
        )
    is_dict = isinstance(env.observation_space, spaces.Dict)
    plain = DictReplayBuffer if is_dict else ReplayBuffer
    return with_intrinsic_reward(arguments.get("replay_buffer_class") or plain)


def _first_update(cls: Callable[..., Algorithm], arguments: Mapping[str, Any], env: VecEnv) -> int:
    """Return ``learning_starts``, late enough for one whole episode to have been stored."""
    longest = longest_episode(env)
    if longest is None:
        raise ConfigError(
            "Hindsight experience replay needs a step limit, and this environment has none; add "
            "+env_kwargs.max_episode_steps=N or ++algorithm.replay_buffer_class=null."
        )
    default = constructor_parameters(cls)["learning_starts"].default
    wanted = int(arguments.get("learning_starts", default))
    needed = longest * env.num_envs + env.num_envs
    if wanted < needed:
        # A default is raised silently, a value that somebody chose is not.
        _log.log(
            logging.DEBUG if wanted == default else logging.INFO,
            "learning_starts raised from %d to %d: hindsight replay needs one whole episode first.",
            wanted,
            needed,
        )
    return max(wanted, needed)


def _shaped_noise(noise: ActionNoise, env: VecEnv) -> ActionNoise:
    """Return noise for each environment, of the actions' shape where it is given as one number."""
    noise, shape = copy.copy(noise), env.action_space.shape or ()
    for name in ("_mu", "_sigma"):
        if hasattr(noise, name):
            setattr(noise, name, np.broadcast_to(getattr(noise, name), shape))
    noise.reset()
    return VectorizedActionNoise(noise, env.num_envs) if env.num_envs > 1 else noise
