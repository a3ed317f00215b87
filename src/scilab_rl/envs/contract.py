"""What an environment returns is held against what it declares, at each step.

Vector environments copy observations into arrays of the declared shape and type: a goal of the
wrong length, or text where a number belongs, would be broadcast or cast and never be noticed.
"""

from __future__ import annotations

import copy
import logging
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.envs.stability import UNSTABLE_KEY
from scilab_rl.errors import did_you_mean
from scilab_rl.metrics.success import success_of

_log = logging.getLogger(__name__)
FAILURE_KEY = "scilab_rl.failure"
STOP, END_EPISODE, IGNORE = "stop", "end_episode", "ignore"
# Bounds are compared at the first steps only: it costs more than all other checks together.
_N_BOUNDED_STEPS = 1000


class BrokenContractError(Exception):
    """An environment returned what it must not return; shown with its name and the step."""


class ContractGuard(gym.Wrapper):
    """Checks keys, shapes and types of observations, rewards and the two flags.

    Args:
        env: The environment with all its other wrappers.
        on_nan: What a NaN or an infinity does: ``stop`` and ``ignore`` leave it to the vector of
            environments; ``end_episode`` truncates the episode there, with the last good
            observation in its place, so that none of it is learned from.
        in_worker: Whether errors are reported in the info, under `FAILURE_KEY`, because they cannot
            be raised across processes.
    """

    def __init__(self, env: gym.Env, on_nan: str = STOP, *, in_worker: bool = False) -> None:
        super().__init__(env)
        self.ends_at_nan = on_nan == END_EPISODE
        self.in_worker = in_worker
        space = env.observation_space
        self._spaces = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        self._is_dict = isinstance(space, spaces.Dict)
        self._accepted_types: dict[str, np.dtype] = {}
        self._n_steps = 0
        self._tells_bounds = True
        self._last: Any = None
        self._action: Any = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        """Begin an episode."""
        self._action = None
        try:
            observation, info = self.env.reset(seed=seed, options=options)
            self._check_observation(observation)
        except Exception as error:
            if not self.in_worker:
                raise
            return self._any_observation(), {FAILURE_KEY: _described(error)}
        if self.ends_at_nan:
            self._last = copy.deepcopy(observation)
        return observation, info

    def step(self, action: Any) -> Any:
        """Act and check what comes back."""
        self._action = action
        try:
            result = self.env.step(action)
            self._check_step(result)
        except Exception as error:
            if not self.in_worker:
                raise
            return self._any_observation(), 0.0, False, False, {FAILURE_KEY: _described(error)}
        return self._without_nan(*result) if self.ends_at_nan else result

    def close(self) -> None:
        """Close the environment; in a worker process, errors go to the log."""
        try:
            self.env.close()
        except Exception as error:
            if not self.in_worker:
                raise
            _log.warning("close() raised %s: %s", *_described(error))

    def _check_step(self, result: Any) -> None:
        if not isinstance(result, tuple) or len(result) != 5:
            raise self._broken(
                "step() must return observation, reward, terminated, truncated, info"
            )
        observation, reward, terminated, truncated, info = result
        self._check_observation(observation)
        if type(reward) is not float and not _is_scalar(reward, "biuf"):
            raise self._broken(f"the reward is {reward!r} and no number")
        for name, flag in (("terminated", terminated), ("truncated", truncated)):
            if type(flag) is not bool and not _is_scalar(flag, "b"):
                raise self._broken(f"{name} is {flag!r} and not True or False")
        if not isinstance(info, dict):
            raise self._broken(f"the info is {info!r} and no dictionary")
        if self._n_steps == 0:
            self._tell_missing_success(info)
        self._n_steps += 1

    def _check_observation(self, observation: Any) -> None:
        if not self._is_dict:
            self._check_entry("", observation)
            return
        if not isinstance(observation, dict):
            raise self._broken(
                f"the observation is of type {type(observation).__name__} and no dictionary"
            )
        for key in self._spaces:
            if key not in observation:
                given = [str(name) for name in observation]
                raise self._broken(
                    f"the observation has no '{key}', which its space has."
                    f"{did_you_mean(key, given)}"
                )
            self._check_entry(key, observation[key])

    def _check_entry(self, key: str, value: Any) -> None:
        space = self._spaces[key]
        shape, dtype = np.shape(value), getattr(value, "dtype", None)
        if shape != space.shape:
            raise self._broken(f"{_name(key)} has shape {shape}, but its space has {space.shape}")
        if dtype is None or dtype != self._accepted_types.get(key):
            dtype = np.asarray(value).dtype
            if space.dtype is not None and not np.can_cast(dtype, space.dtype, "same_kind"):
                raise self._broken(
                    f"{_name(key)} is of type {dtype}, but its space of {space.dtype}"
                )
            self._accepted_types[key] = dtype
        if self._n_steps < _N_BOUNDED_STEPS and self._tells_bounds:
            self._compare_with_bounds(_name(key), value, space)

    def _broken(self, what: str) -> BrokenContractError:
        acted = "" if self._action is None else f"; last action {np.asarray(self._action)}"
        return BrokenContractError(what + acted)

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
        elif isinstance(space, spaces.Discrete) and not space.contains(np.int64(value)):
            raise self._broken(f"{name} is {value}, outside of its space {space}")

    def _tell_missing_success(self, info: dict[str, Any]) -> None:
        if "desired_goal" in self._spaces and success_of(info) is None:
            _log.warning(
                "%s has goals, but its infos have no 'is_success': there will be no success rate.",
                self._env_name,
            )

    def _without_nan(
        self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any
    ) -> Any:
        entries = observation.values() if self._is_dict else [observation]
        if np.isfinite(reward) and all(_is_finite(entry) for entry in entries):
            self._last = copy.deepcopy(observation)
            return observation, reward, terminated, truncated, info
        return self._last, 0.0, False, True, {**info, UNSTABLE_KEY: True}

    @property
    def _env_name(self) -> str:
        return self.spec.id if self.spec else type(self.unwrapped).__name__

    def _any_observation(self) -> Any:
        """Return something that can be sent; nobody will look at it."""
        return self.observation_space.sample()


def _name(key: str) -> str:
    return f"observation '{key}'" if key else "the observation"


def _described(error: Exception) -> tuple[str, str]:
    """Return an error's kind and what it says."""
    return type(error).__name__, " ".join(str(error).split())


def _is_scalar(value: Any, kinds: str) -> bool:
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in kinds


def _is_finite(value: Any) -> bool:
    array = np.asarray(value)
    return array.dtype.kind != "f" or bool(np.isfinite(array).all())
