"""The spaces that algorithms are given: one canonical form per kind, whatever the environment has.

Algorithms count discrete values from 0, act in float32 and read arrays with at least one dimension.
An environment that differs gets a thin layer here that converts actions and observations:

===================================================  ==============================================
the environment's space                              what the algorithm is given
===================================================  ==============================================
``Discrete``, ``MultiDiscrete`` with a ``start``     the same, counted from 0, in one dimension
``MultiBinary`` actions of several dimensions        the same, in one dimension
``Box(shape=())``                                    ``Box(shape=(1,))``
``Box`` actions of another dtype than float32        ``Box(-1, 1, float32)``, converted in float64
``Box`` actions of float32 with ``low == high``      free there; the locked value is sent
===================================================  ==============================================

All other spaces, the ordinary ones, get no layer.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from scilab_rl.errors import ConfigError
from scilab_rl.space_checks import bounds_problem

_GOAL_KEYS = ("achieved_goal", "desired_goal")


class Conversion:
    """Converts batches between the environment's space and the one that algorithms are given.

    This one changes nothing.

    Args:
        env_space: The environment's space.
        space: What algorithms are given.

    Shapes:
        all values: ``(batch, ...)`` per entry.
    """

    def __init__(self, env_space: spaces.Space, space: spaces.Space | None = None) -> None:
        self.env_space = env_space
        self.space = env_space if space is None else space
        self.changes_nothing = self.space is env_space

    def from_env(self, values: Any) -> Any:
        """Convert the environment's values into the algorithm's."""
        return values

    def to_env(self, values: Any) -> Any:
        """Convert the algorithm's values into the environment's."""
        return values

    def one_from_env(self, value: Any) -> Any:
        """Convert a single value."""
        return _first(self.from_env(_batch_of_one(value)))

    def one_to_env(self, value: Any) -> Any:
        """Convert a single value back."""
        return _first(self.to_env(_batch_of_one(value)))


class _Counted(Conversion):
    """Counts from 0, in one dimension."""

    def __init__(self, env_space: Any, space: spaces.Space) -> None:
        super().__init__(env_space, space)
        self.start = getattr(env_space, "start", 0)

    def from_env(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values)
        return (values - self.start).reshape(len(values), *(self.space.shape or ()))

    def to_env(self, values: np.ndarray) -> np.ndarray:
        shape = self.env_space.shape or ()
        return (np.reshape(values, (len(values), *shape)) + self.start).astype(self.env_space.dtype)


class _Clipped(Conversion):
    """float32 actions in the environment's units; what is beyond the bounds is cut off."""

    def __init__(self, env_space: spaces.Box) -> None:
        is_locked = env_space.low == env_space.high
        shape = env_space.shape or (1,)
        low = np.where(is_locked, np.float32(-1), env_space.low).reshape(shape)
        high = np.where(is_locked, np.float32(1), env_space.high).reshape(shape)
        super().__init__(env_space, spaces.Box(low, high))
        self.is_locked = is_locked.reshape(shape)

    def from_env(self, values: np.ndarray) -> np.ndarray:
        values = np.reshape(values, (len(values), *self.is_locked.shape))
        return np.where(self.is_locked, np.float32(0), values)

    def to_env(self, values: np.ndarray) -> np.ndarray:
        space: Any = self.env_space
        return np.clip(np.reshape(values, (len(values), *space.shape)), space.low, space.high)


class _Scaled(Conversion):
    """Floating-point actions of another dtype, scaled from [-1, 1] in float64."""

    def __init__(self, env_space: spaces.Box) -> None:
        super().__init__(env_space, spaces.Box(-1.0, 1.0, env_space.shape or (1,), np.float32))
        self.low, self.high = (np.asarray(b, np.float64) for b in (env_space.low, env_space.high))
        self.width = self.high - self.low

    def from_env(self, values: np.ndarray) -> np.ndarray:
        share = (np.asarray(values, np.float64) - self.low) / np.where(self.width, self.width, 1.0)
        scaled = np.where(self.width, 2.0 * share - 1.0, 0.0)
        return scaled.astype(np.float32).reshape(len(values), *(self.space.shape or ()))

    def to_env(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, np.float64).reshape(len(values), *(self.env_space.shape or ()))
        scaled = self.low + 0.5 * (values + 1.0) * self.width
        return np.clip(scaled, self.low, self.high).astype(self.env_space.dtype)


class _Binned(Conversion):
    """Whole-number actions: each value has an equal part of [-1, 1], and is its middle."""

    def __init__(self, env_space: spaces.Box) -> None:
        super().__init__(env_space, spaces.Box(-1.0, 1.0, env_space.shape or (1,), np.float32))
        # Modulo 2^64, so that no difference overflows.
        self.low = env_space.low.astype(np.uint64)
        self.last = env_space.high.astype(np.uint64) - self.low
        self.n = self.last + 1.0

    def from_env(self, values: np.ndarray) -> np.ndarray:
        index = np.asarray(values, self.env_space.dtype).astype(np.uint64) - self.low
        scaled = (2.0 * index + 1.0) / self.n - 1.0
        return scaled.astype(np.float32).reshape(len(values), *(self.space.shape or ()))

    def to_env(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, np.float64).reshape(len(values), *(self.env_space.shape or ()))
        if not np.isfinite(values).all():
            return values  # no whole number; the environments' own layer refuses it by name
        index = np.clip(np.floor(0.5 * (values + 1.0) * self.n), 0.0, self.last)
        return (self.low + index.astype(np.uint64)).astype(self.env_space.dtype)


class _Entries(Conversion):
    """Converts the entries of dictionaries."""

    def __init__(self, env_space: spaces.Dict, entries: dict[str, Conversion]) -> None:
        converted = {key: entry.space for key, entry in entries.items()}
        # Copies: the environment may draw from its own, with their generators.
        own = copy.deepcopy(dict(env_space.spaces))
        super().__init__(env_space, spaces.Dict(own | converted))
        self.entries = entries

    def from_env(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**values, **{key: e.from_env(values[key]) for key, e in self.entries.items()}}

    def to_env(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**values, **{key: e.to_env(values[key]) for key, e in self.entries.items()}}


def action_conversion(space: spaces.Space) -> Conversion:
    """Return how actions get from the algorithm's to the environment's space."""
    if isinstance(space, spaces.Box):
        return _box_actions(space)
    if isinstance(space, spaces.MultiBinary) and len(space.shape) > 1:
        return _Counted(space, spaces.MultiBinary(int(np.prod(space.shape))))
    return _counted(space)


def observation_conversion(space: spaces.Space) -> Conversion:
    """Return how observations get from the environment's to the algorithm's space.

    Raises:
        ConfigError: If goals would have to be converted: rewards are computed from them.
    """
    if isinstance(space, spaces.Dict):
        found = {key: observation_conversion(entry) for key, entry in space.spaces.items()}
        entries = {key: entry for key, entry in found.items() if not entry.changes_nothing}
        if goals := [key for key in _GOAL_KEYS if key in entries and set(_GOAL_KEYS) <= set(found)]:
            raise ConfigError(
                f"'{goals[0]}' is {space[goals[0]]}, but goals must be arrays with at least one "
                "dimension, counted from 0 where they are discrete."
            )
        return _Entries(space, entries) if entries else Conversion(space)
    if isinstance(space, spaces.Box) and space.shape == ():
        low, high = space.low.reshape(1), space.high.reshape(1)
        return _Counted(space, spaces.Box(low, high, dtype=space.dtype.type))
    return _counted(space)


class CanonicalVecEnv(VecEnvWrapper):
    """Gives algorithms canonical spaces; what is below it has the environment's own values.

    Args:
        venv: The vector environment.

    Attributes:
        actions: Conversion of the actions.
        observations: Conversion of the observations.
    """

    def __init__(self, venv: VecEnv) -> None:
        self.actions = action_conversion(venv.action_space)
        self.observations = observation_conversion(venv.observation_space)
        super().__init__(venv, self.observations.space, self.actions.space)

    def reset(self) -> VecEnvObs:
        """Reset all environments."""
        return self.observations.from_env(self.venv.reset())

    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step."""
        self.venv.step_async(self.actions.to_env(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        if self.observations.changes_nothing:
            return observations, rewards, dones, infos
        # The observers below keep their dictionaries.
        infos = [self._with_converted_end(info) for info in infos]
        return self.observations.from_env(observations), rewards, dones, infos

    def _with_converted_end(self, info: dict[str, object]) -> dict[str, object]:
        if "terminal_observation" not in info:
            return info
        last = self.observations.one_from_env(info["terminal_observation"])
        return info | {"terminal_observation": last}


def with_canonical_spaces(env: VecEnv) -> VecEnv:
    """Return an environment with canonical spaces: itself, if it has them already."""
    layer = CanonicalVecEnv(env)
    both = (layer.actions, layer.observations)
    return env if all(conversion.changes_nothing for conversion in both) else layer


def check_canonical(name: str, env: VecEnv) -> None:
    """Reject an environment whose values an algorithm would take for others.

    Args:
        name: The algorithm.
        env: What it is given.

    Raises:
        ConfigError: If it needs a `CanonicalVecEnv` and has none.
    """
    if unwrap_vec_wrapper(env, CanonicalVecEnv) is None and with_canonical_spaces(env) is not env:
        raise ConfigError(
            f"{name} counts from 0 and acts in float32, but the environment has "
            f"{env.action_space} and {env.observation_space}; make it with "
            "scilab_rl.canonical_spaces.with_canonical_spaces."
        )


def conversions(env: VecEnv) -> tuple[Conversion, Conversion]:
    """Return the conversions of actions and observations between an algorithm and its tasks."""
    layer = unwrap_vec_wrapper(env, CanonicalVecEnv)
    if layer is None:
        return Conversion(env.action_space), Conversion(env.observation_space)
    return layer.actions, layer.observations


def _box_actions(space: spaces.Box) -> Conversion:
    if bounds_problem(space):
        return Conversion(space)  # `check_pair` says why
    if space.dtype.kind != "f":
        return _Binned(space)
    if space.dtype != np.float32:
        return _Scaled(space)
    # Rounding may lead beyond the upper bound: Stable-Baselines3 scales without clipping.
    is_exceeded = space.low + (space.high - space.low) > space.high
    is_ordinary = space.shape and not (is_exceeded | (space.low == space.high)).any()
    return Conversion(space) if is_ordinary else _Clipped(space)


def _counted(space: spaces.Space) -> Conversion:
    if isinstance(space, spaces.Discrete) and space.start != 0:
        return _Counted(space, spaces.Discrete(int(space.n)))
    if isinstance(space, spaces.MultiDiscrete) and (space.start.any() or space.nvec.ndim > 1):
        return _Counted(space, spaces.MultiDiscrete(space.nvec.ravel()))
    return Conversion(space)


def _batch_of_one(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: np.asarray(value)[None] for key, value in values.items()}
    return np.asarray(values)[None]


def _first(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: value[0] for key, value in values.items()}
    return values[0]
