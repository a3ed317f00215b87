"""Which algorithm can work with which environment, decided before the first step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from gymnasium import spaces

from scilab_rl.errors import ConfigError

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")

_CONTINUOUS = (spaces.Box,)
_DISCRETE = (spaces.Discrete,)
_ANY = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
# Stable-Baselines3 states these only inside its constructors. One-file algorithms state their own
# in the class attribute `supported_action_spaces`.
_ACTION_SPACES: dict[str, tuple[type[spaces.Space], ...]] = {
    "SAC": _CONTINUOUS,
    "TD3": _CONTINUOUS,
    "DDPG": _CONTINUOUS,
    "TQC": _CONTINUOUS,
    "CrossQ": _CONTINUOUS,
    "DQN": _DISCRETE,
    "QRDQN": _DISCRETE,
    "PPO": _ANY,
    "A2C": _ANY,
    "TRPO": _ANY,
}


def supported_action_spaces(cls: type) -> tuple[type[spaces.Space], ...] | None:
    """Return the action spaces of an algorithm class, or None when it does not say."""
    for ancestor in cls.__mro__:
        if "supported_action_spaces" in vars(ancestor):
            return tuple(vars(ancestor)["supported_action_spaces"])
        if ancestor.__name__ in _ACTION_SPACES and ancestor.__module__.startswith(
            ("stable_baselines3", "sb3_contrib")
        ):
            return _ACTION_SPACES[ancestor.__name__]
    return None


def reads_dictionaries(cls: type) -> bool:
    """Tell whether an algorithm class has a policy for Dict observations, and so for goals."""
    # CrossQ of sb3-contrib has none. One-file algorithms have no list of policies and read all.
    return "MultiInputPolicy" in getattr(cls, "policy_aliases", ("MultiInputPolicy",))


def is_goal_space(space: spaces.Space) -> bool:
    """Tell whether observations carry an achieved and a desired goal."""
    return isinstance(space, spaces.Dict) and all(key in space.spaces for key in GOAL_KEYS)


def is_image_space(space: spaces.Space) -> bool:
    """Tell whether observations are images."""
    return isinstance(space, spaces.Box) and len(space.shape) == 3 and space.dtype == "uint8"


def check_pair(
    name: str, cls: type, env_id: str, env: Any, fitting: Callable[[], Iterable[str]] = tuple
) -> None:
    """Refuse an algorithm and environment that cannot work together.

    Args:
        name: The algorithm's name.
        cls: Its class.
        env_id: The environment's id.
        env: Anything with ``observation_space`` and ``action_space``.
        fitting: Returns the names of algorithms that work with this environment, for the message.

    Raises:
        ConfigError: With the algorithms that can.
    """
    allowed = supported_action_spaces(cls)
    action_space, observation_space = env.action_space, env.observation_space
    if allowed is not None and not isinstance(action_space, allowed):
        others = ", ".join(fitting())
        raise ConfigError(
            f"{name} needs {_names(allowed)} actions, but {env_id} has "
            f"{type(action_space).__name__} actions. "
            + (f"These can: {others}." if others else "None of the algorithms can.")
        )
    if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
        raise ConfigError(
            f"{env_id} has unbounded actions; wrap it so that low and high are finite."
        )
    if isinstance(observation_space, spaces.Dict):
        _check_dictionary(name, cls, env_id, observation_space)
    elif isinstance(observation_space, spaces.Tuple):
        raise ConfigError(
            f"{env_id} has Tuple observations, which no algorithm here reads; add +flatten_obs=1."
        )


def _check_dictionary(name: str, cls: type, env_id: str, space: spaces.Dict) -> None:
    if any(isinstance(entry, (spaces.Dict, spaces.Tuple)) for entry in space.spaces.values()):
        raise ConfigError(f"{env_id} has nested dictionaries as observations; add +flatten_obs=1.")
    if not reads_dictionaries(cls):
        raise ConfigError(
            f"{name} reads plain vectors, but {env_id} has Dict observations; add +flatten_obs=1."
        )


def _names(kinds: Iterable[type[spaces.Space]]) -> str:
    return " or ".join(kind.__name__ for kind in kinds)
