"""Which algorithm can work with which environment, decided before the first step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from scilab_rl.errors import ConfigError
from scilab_rl.space_checks import bounds_problem

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
_SMALLEST_IMAGE = 36  # of Stable-Baselines3's convolutional network, in pixels

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
    "RecurrentPPO": (spaces.Box, spaces.Discrete, spaces.MultiDiscrete),  # its padding is a float
    "A2C": _ANY,
    "TRPO": _ANY,
}


class HasSpaces(Protocol):
    """An environment, of any kind."""

    @property
    def observation_space(self) -> spaces.Space:
        """What it shows."""

    @property
    def action_space(self) -> spaces.Space:
        """What can be done."""


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
    """Return whether an algorithm class has a policy for Dict observations, and so for goals."""
    # CrossQ of sb3-contrib has none. One-file algorithms have no list of policies and read all.
    names = {"MultiInputPolicy", "MultiInputLstmPolicy"}
    return not names.isdisjoint(getattr(cls, "policy_aliases", names))


def is_goal_space(space: spaces.Space) -> bool:
    """Return whether observations carry an achieved and a desired goal."""
    return isinstance(space, spaces.Dict) and all(key in space.spaces for key in GOAL_KEYS)


def is_large_image(space: spaces.Space) -> bool:
    """Return whether Stable-Baselines3's convolutional network can read these observations."""
    return is_image_space(space) and sorted(space.shape or ())[1] >= _SMALLEST_IMAGE


def longest_episode(env: VecEnv) -> int | None:
    """Return the step limit of episodes, or None where there is none."""
    limits = [spec.max_episode_steps if spec else None for spec in env.get_attr("spec")]
    known = [limit for limit in limits if limit]
    return max(known) if len(known) == len(limits) else None


def check_pair(
    name: str,
    cls: type,
    env_id: str,
    env: HasSpaces,
    fitting: Callable[[], Iterable[str]] = tuple,
    *,
    own_extractor: bool = False,
) -> None:
    """Reject an algorithm and environment that cannot work together.

    Args:
        name: The algorithm's name.
        cls: Its class.
        env_id: The environment's id.
        env: Anything with ``observation_space`` and ``action_space``.
        fitting: Returns the names of algorithms that work with this environment, for the message.
        own_extractor: Whether the user's own network reads the observations.

    Raises:
        ConfigError: With the algorithms that can.
    """
    allowed = supported_action_spaces(cls)
    action_space, observation_space = env.action_space, env.observation_space
    if allowed is not None and not isinstance(action_space, allowed):
        raise ConfigError(
            f"{name} needs {_names(allowed)} actions, but {env_id} has "
            f"{type(action_space).__name__} actions. {_which_can(fitting)}"
        )
    if getattr(cls, "needs_goals", False) and not is_goal_space(observation_space):
        raise ConfigError(
            f"{name} learns to reach goals, and {env_id} has none (Dict observations with "
            f"{', '.join(GOAL_KEYS)}). {_which_can(fitting)}"
        )
    if _is_recurrent(cls) and _has_dice(observation_space):
        raise ConfigError(
            f"{name} cannot read MultiDiscrete observations, which {env_id} has; add "
            "+flatten_obs=1."
        )
    problem_of = getattr(cls, "observation_problem", None)
    if problem_of is not None and (why := problem_of(observation_space)):
        raise ConfigError(f"{name} cannot act in {env_id}: {why}")
    if isinstance(action_space, spaces.Box) and (problem := bounds_problem(action_space)):
        raise ConfigError(
            f"The actions of {env_id} have {problem}; give them some with 'wrappers=[{{_target_: "
            "scilab_rl.envs.clipping.ClipAction, low: -1, high: 1}]'."
        )
    if isinstance(observation_space, spaces.Dict):
        if not reads_dictionaries(cls):
            raise ConfigError(
                f"{name} reads plain vectors, but {env_id} has Dict observations; add "
                "+flatten_obs=1."
            )
        # One-file algorithms join the entries into one vector.
        if hasattr(cls, "policy_aliases") and not own_extractor:
            _check_entries(name, env_id, observation_space, fitting)


def _check_entries(
    name: str, env_id: str, space: spaces.Dict, fitting: Callable[[], Iterable[str]]
) -> None:
    """Reject entries for which Stable-Baselines3's extractor makes no network."""
    for key, entry in space.spaces.items():
        why = _unreadable(key, entry)
        if why:
            others = ", ".join(fitting())
            raise ConfigError(
                f"{name} cannot read the observation '{key}' of {env_id}: {why}. Add "
                "+flatten_obs=1, or gymnasium.wrappers.FlattenObservation as the last of your own "
                f"wrappers{f'; or take one of these: {others}' if others else ''}."
            )


def _unreadable(key: str, entry: spaces.Space) -> str | None:
    """Return why Stable-Baselines3's policies have no network for an entry; None: they have."""
    if "." in key or hasattr(nn.ModuleDict(), key) or not key:
        return "PyTorch has no modules of this name"
    if is_image_space(entry) and not is_large_image(entry):
        return f"its network for images needs at least {_SMALLEST_IMAGE} x {_SMALLEST_IMAGE} pixels"
    return None


def _is_recurrent(cls: type) -> bool:
    return "MlpLstmPolicy" in getattr(cls, "policy_aliases", ())


def _has_dice(space: spaces.Space) -> bool:
    """Return whether there are MultiDiscrete numbers, for which an LSTM gets no proper size."""
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return any(isinstance(part, spaces.MultiDiscrete) for part in parts)


def _which_can(fitting: Callable[[], Iterable[str]]) -> str:
    others = ", ".join(fitting())
    return f"These can: {others}." if others else "None of the algorithms can."


def _names(kinds: Iterable[type[spaces.Space]]) -> str:
    return " or ".join(kind.__name__ for kind in kinds)
