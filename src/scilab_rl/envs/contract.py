"""Validate every step of an environment against its declared spaces.

Vector environments copy observations into arrays of the declared shape and type: a goal of the
wrong length, or text where a number belongs, would be broadcast or cast and never be noticed.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.errors import did_you_mean
from scilab_rl.metrics.success import success_of

_log = logging.getLogger(__name__)
# Bounds are compared at the first steps only: it costs more than all other checks together.
_N_BOUNDED_STEPS = 1000


class BrokenContractError(Exception):
    """An environment returned what it must not return; shown with its name and the step."""


class StepContract:
    """Checks keys, shapes and types of observations, rewards and the two flags.

    Args:
        env: The environment with all its wrappers.
    """

    def __init__(self, env: gym.Env) -> None:
        space, inner = env.observation_space, env.unwrapped
        self._spaces = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        self._is_dict = isinstance(space, spaces.Dict)
        self._env_name = inner.spec.id if inner.spec else type(inner).__name__
        self._accepted_types: dict[str, np.dtype] = {}
        self._n_steps = 0
        self._tells_bounds = True
        self._unbounded = {key for key, space in self._spaces.items() if _is_unbounded(space)}

    def check_reset(self, observation: object, info: Mapping[str, object]) -> None:
        """Check what a reset has returned.

        Raises:
            BrokenContractError: Says what is wrong.
        """
        self._check_observation(observation)
        _reported_success(info)

    def check_step(self, result: object, action: object) -> None:
        """Check what a step has returned.

        Args:
            result: All of it.
            action: What was sent, for the message.

        Raises:
            BrokenContractError: Says what is wrong.
        """
        try:
            self._check_result(result)
        except BrokenContractError as error:
            raise BrokenContractError(f"{error}; last action {np.asarray(action)}") from None

    def _check_result(self, result: object) -> None:
        if not isinstance(result, tuple) or len(result) != 5:
            raise BrokenContractError(
                "step() must return observation, reward, terminated, truncated, info"
            )
        observation, reward, terminated, truncated, info = result
        self._check_observation(observation)
        if type(reward) is not float and not _is_scalar(reward, "biuf"):
            raise BrokenContractError(f"the reward is {reward!r} and not a number")
        for name, flag in (("terminated", terminated), ("truncated", truncated)):
            if type(flag) is not bool and not _is_scalar(flag, "b"):
                raise BrokenContractError(f"{name} is {flag!r} and not True or False")
        if not isinstance(info, dict):
            raise BrokenContractError(f"the info is {info!r} and not a dictionary")
        success = _reported_success(info)
        if self._n_steps == 0 and success is None:
            self._tell_missing_success()
        self._n_steps += 1

    def _check_observation(self, observation: object) -> None:
        if not self._is_dict:
            self._check_entry("", observation)
            return
        if not isinstance(observation, dict):
            raise BrokenContractError(
                f"the observation is of type {type(observation).__name__} and not a dictionary"
            )
        for key in self._spaces:
            if key not in observation:
                given = [str(name) for name in observation]
                raise BrokenContractError(
                    f"the observation has no '{key}', which its space has."
                    f"{did_you_mean(key, given)}"
                )
            self._check_entry(key, observation[key])

    def _check_entry(self, key: str, value: Any) -> None:
        space = self._spaces[key]
        shape, dtype = np.shape(value), getattr(value, "dtype", None)
        if shape != space.shape:
            raise BrokenContractError(
                f"{_name(key)} has shape {shape}, but its space has {space.shape}"
            )
        if dtype is None or dtype != self._accepted_types.get(key):
            dtype = np.asarray(value).dtype
            if space.dtype is not None and not np.can_cast(dtype, space.dtype, "same_kind"):
                raise BrokenContractError(
                    f"{_name(key)} is of type {dtype}, but its space of {space.dtype}"
                )
            self._accepted_types[key] = dtype
        if self._n_steps < _N_BOUNDED_STEPS and self._tells_bounds and key not in self._unbounded:
            self._compare_with_bounds(_name(key), value, space)

    def _compare_with_bounds(self, name: str, value: Any, space: spaces.Space) -> None:
        if isinstance(space, spaces.Box):
            outside = np.argwhere((value < space.low) | (value > space.high))
            if len(outside):
                index = tuple(map(int, outside[0]))
                self._tells_bounds = False
                _log.warning(
                    "%s: %s is %s at index %s, outside of its space's bounds [%s, %s].",
                    self._env_name, name, np.asarray(value)[index], index, space.low[index],
                    space.high[index],
                )  # fmt: skip
        elif isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) and not space.contains(
            np.asarray(value, space.dtype)
        ):
            raise BrokenContractError(f"{name} is {value}, outside of its space {space}")

    def _tell_missing_success(self) -> None:
        if "desired_goal" in self._spaces:
            _log.warning(
                "%s has goals, but the info of its first step has no 'is_success': unless it comes "
                "at the end of episodes, there will be no success rate.",
                self._env_name,
            )


def is_finite(observation: object, reward: object) -> bool:
    """Return whether neither a reward nor any entry of an observation is NaN or infinite."""
    entries = observation.values() if isinstance(observation, dict) else [observation]
    return all(map(_is_finite, (reward, *entries)))


def _reported_success(info: Mapping[str, object]) -> bool | None:
    try:
        return success_of(info)
    except ValueError as error:
        raise BrokenContractError(str(error)) from error


def _name(key: str) -> str:
    return f"observation '{key}'" if key else "the observation"


def _is_unbounded(space: spaces.Space) -> bool:
    if not isinstance(space, spaces.Box):
        return False
    return not (np.isfinite(space.low).any() or np.isfinite(space.high).any())


def _is_scalar(value: object, kinds: str) -> bool:
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in kinds


def _is_finite(value: object) -> bool:
    array = np.asarray(value)
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())
