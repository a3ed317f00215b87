"""Continuing in the middle of an episode, for any deterministic environment.

A simulator's state cannot be saved in general, but an episode can be told again: the state of the
random generator just before ``reset`` and the actions since then lead to the same place.
"""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium as gym
import numpy as np


class ReplayableEpisode(gym.Wrapper):
    """Remembers what is needed to repeat the running episode; costs one list entry per step.

    Args:
        env: The environment with all its other wrappers.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._reset_arguments: dict[str, Any] = {}
        self._generator_state: Any = None
        self._actions: list[Any] = []

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        """Begin an episode and remember how."""
        self._reset_arguments = {"seed": seed, "options": options}
        self._generator_state = None if seed is not None else self._generator().bit_generator.state
        self._actions = []
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """Act and remember the action."""
        self._actions.append(np.array(action))
        return self.env.step(action)

    def episode_state(self) -> dict[str, Any]:
        """Return what ``replay_episode`` needs: generator state, reset arguments and actions."""
        return {
            "reset_arguments": self._reset_arguments,
            "generator_state": self._generator_state,
            "actions": np.array(self._actions) if self._actions else None,
        }

    def replay_episode(self, state: dict[str, Any]) -> Any:
        """Return to a remembered place in an episode.

        Args:
            state: From ``episode_state`` of the same environment, perhaps in another process.

        Returns:
            The observation there.
        """
        if state["generator_state"] is not None:
            self._generator().bit_generator.state = state["generator_state"]
        arguments = state["reset_arguments"]
        self._reset_arguments = dict(arguments)
        observation, _ = self.env.reset(**arguments)
        self._generator_state = state["generator_state"]
        actions = [] if state["actions"] is None else list(state["actions"])
        self._actions = [np.array(action) for action in actions]
        for action in actions:
            observation = self.env.step(action)[0]
        return observation

    def pickled_method(self, name: str) -> bytes | None:
        """Return a method with a copy of its environment, or None where that cannot be pickled.

        For pure functions, such as ``compute_reward``, that another process calls often.
        """
        try:
            return pickle.dumps(self.get_wrapper_attr(name))
        except Exception:  # noqa: BLE001 - any object may fail in its own way
            return None

    def _generator(self) -> np.random.Generator:
        return self.env.unwrapped.np_random
