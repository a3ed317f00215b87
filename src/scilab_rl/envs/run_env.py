"""The one wrapper of ours around each environment of a run: it checks, captures and repeats.

A simulator's state cannot be saved in general, but an episode can be replayed: the state of the
random generator and of the wrappers just before ``reset``, and the actions since then, lead to the
same place.
"""

from __future__ import annotations

import logging
import pickle
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np

from scilab_rl.envs.contract import StepContract, is_finite
from scilab_rl.envs.frames import FrameCapture
from scilab_rl.envs.goal_setting import EpisodePlan, reset_with_goal
from scilab_rl.envs.stability import UNSTABLE_KEY
from scilab_rl.envs.types import Info, ResetResult, StepResult
from scilab_rl.envs.wrapper_memory import Memory, memory_of, owned, set_memory, unknown_memory

_log = logging.getLogger(__name__)
FAILURE_KEY = "scilab_rl.failure"
START_KEY = "scilab_rl.episode_start"
# What `replay_episode` needs, without actions.
EpisodeStart: TypeAlias = dict[str, Any]
STOP, END_EPISODE, IGNORE = "stop", "end_episode", "ignore"


class RunEnv(gym.Wrapper):
    """Checks what an environment returns, captures its frames and remembers the running episode.

    It is also where arrays change hands: the environment gets an action of its own, and what it has
    given is copied, so that neither side's changes in place reach the other.

    Args:
        env: The environment with all its other wrappers.
        on_nan: What a NaN or an infinity does: ``stop`` and ``ignore`` leave it to the vector of
            environments; ``end_episode`` truncates the episode there, with the last good
            observation in its place, so that none of it is learned from.
        in_worker: Whether errors are reported in the info, under `FAILURE_KEY`, because they cannot
            be raised across processes.
        view: How scenes are drawn, ``task`` or ``close``.
    """

    def __init__(
        self, env: gym.Env, on_nan: str = STOP, *, in_worker: bool = False, view: str = "task"
    ) -> None:
        super().__init__(env)
        self._contract = StepContract(env)
        self._frames = FrameCapture(env, view)
        self._ends_at_nan, self._in_worker = on_nan == END_EPISODE, in_worker
        self._last_good: object = None
        self._reset_arguments: Info = {}
        self._generator_state: Mapping[str, object] | None = None
        self._actions: list[np.ndarray] = []
        self._memory: Memory = {}
        self._plans: deque[EpisodePlan] = deque()

    def plan_episodes(self, plans: Iterable[EpisodePlan]) -> None:
        """Say how the next episodes begin, whoever resets; later ones begin as they are asked to.

        Args:
            plans: In order; they replace those that are left of an earlier call.
        """
        self._plans = deque(plans)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin an episode and remember how."""
        if self._plans:
            plan = self._plans.popleft()
            seed, options = plan.seed, plan.options
        self._reset_arguments = {"seed": seed, "options": options}
        self._generator_state = None if seed is not None else self._generator.bit_generator.state
        self._actions = []
        self._memory = memory_of(self.env)
        observation, info = self._begin(seed, options)
        if self._frames.is_capturing:
            info[START_KEY] = self.episode_start()
        return observation, info

    def step(self, action: np.ndarray) -> StepResult:
        """Act, check what comes back and remember the action."""
        self._actions.append(np.array(action))
        return self._advance(action)

    def close(self) -> None:
        """Close the environment; in a worker process, errors go to the log."""
        try:
            self.env.close()
        except Exception as error:
            if not self._in_worker:
                raise
            _log.warning("close() raised %s: %s", *_described(error))

    def capture_frames(self, on: bool) -> None:
        """Switch capturing on, from the next reset, or off, at once."""
        self._frames.capture(on)

    def draw(self) -> np.ndarray | str:
        """Return a picture of the present scene, which changes nothing, or why there is none."""
        return self._frames.draw()

    def leave_out_pictures(self, reason: str) -> None:
        """Render nothing from now on, because it cannot be done here."""
        self._frames.leave_out(reason)

    def episode_state(self) -> dict[str, object]:
        """Return what ``replay_episode`` needs: states before the reset, its arguments, actions."""
        actions = np.array(self._actions) if self._actions else None
        return {**self.episode_start(), "actions": actions}

    def episode_start(self) -> EpisodeStart:
        """Return the same without the actions."""
        return {
            "reset_arguments": self._reset_arguments,
            "generator_state": self._generator_state,
            "memory": self._memory,
        }

    def continue_episode(self, start: EpisodeStart, actions: Sequence[np.ndarray]) -> None:
        """Remember another episode as the running one, which the environment was put into.

        Args:
            start: How it began.
            actions: What was done until here.
        """
        self._reset_arguments = dict(start["reset_arguments"])
        self._generator_state, self._memory = start["generator_state"], start["memory"]
        self._actions = list(actions)

    def reseed(self, seed: int) -> None:
        """Give the rest of the episode other random numbers; it cannot be replayed any more."""
        kind = type(self._generator.bit_generator)
        self._generator.bit_generator.state = kind(seed).state

    def replay_episode(self, state: Info) -> object:
        """Return to a remembered place in an episode.

        Args:
            state: From ``episode_state`` of the same environment, perhaps in another process.

        Returns:
            The observation there.
        """
        if state["generator_state"] is not None:
            self._generator.bit_generator.state = state["generator_state"]
        self.set_wrapper_memory(state.get("memory") or {})
        self._memory = memory_of(self.env)
        self._reset_arguments = dict(state["reset_arguments"])
        observation, _ = self._begin(**self._reset_arguments)
        self._generator_state = state["generator_state"]
        actions = [] if state["actions"] is None else list(state["actions"])
        self._actions = [np.array(action) for action in actions]
        for action in actions:
            observation = self._advance(action)[0]
        return observation

    def wrapper_memory(self) -> Memory:
        """Return what the wrappers remember, see `wrapper_memory.memory_of`."""
        return memory_of(self.env)

    def set_wrapper_memory(self, memory: Memory) -> None:
        """Give the wrappers what `wrapper_memory` has returned, perhaps elsewhere."""
        set_memory(self.env, memory)

    def unknown_memory(self) -> list[str]:
        """Return what the wrappers hold and nobody can save, as ``Wrapper.attribute``."""
        return unknown_memory(memory_of(self.env))

    def pickled_method(self, name: str) -> bytes | None:
        """Return a method with a copy of its environment, or None where that cannot be pickled.

        For pure functions, such as ``compute_reward``, that another process calls often.
        """
        try:
            return pickle.dumps(self.env.get_wrapper_attr(name))
        except Exception:  # noqa: BLE001 - any object may fail in its own way
            return None

    def _begin(self, seed: int | None, options: Info | None) -> ResetResult:
        try:
            observation, info = reset_with_goal(self.env, seed=seed, options=options)
            self._contract.check_reset(observation, info)
            observation, info = owned(observation), owned(info)
            self._frames.begin_episode(info)
        except Exception as error:
            if not self._in_worker:
                raise
            return self._placeholder(error)
        if self._ends_at_nan:
            self._last_good = owned(observation)
        return observation, info

    def _advance(self, action: np.ndarray) -> StepResult:
        try:
            result = self.env.step(owned(action))
            self._contract.check_step(result, action)
            observation, reward, terminated, truncated, info = result
            info = owned(info)
            self._frames.add_to(info)
        except Exception as error:
            if not self._in_worker:
                raise
            observation, info = self._placeholder(error)
            return observation, 0.0, False, False, info
        if self._ends_at_nan:
            if not is_finite(observation, reward):
                return self._last_good, 0.0, False, True, {**info, UNSTABLE_KEY: True}
            self._last_good = owned(observation)
        if terminated or truncated:  # otherwise the vector environment copies it at once
            observation = owned(observation)
        return observation, reward, terminated, truncated, info

    def _placeholder(self, error: Exception) -> ResetResult:
        """Return an observation that nobody will look at and an info that reports the error."""
        return self.observation_space.sample(), {FAILURE_KEY: _described(error)}

    @property
    def _generator(self) -> np.random.Generator:
        return self.env.unwrapped.np_random


def _described(error: Exception) -> tuple[str, str]:
    """Return an error's kind and what it says."""
    return type(error).__name__, " ".join(str(error).split())
