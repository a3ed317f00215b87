"""A vector environment whose environments are shared out among processes or threads.

Each steps its share of the environments one after the other and answers once. Where they are is
the matter of subclasses: `workers.WorkersVecEnv` and `threads.ThreadsVecEnv`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from stable_baselines3.common.vec_env.util import dict_to_obs

from scilab_rl.envs.types import Info

# The name of a method of `Share`, its arguments and its keyword arguments.
Call = tuple[str, tuple[object, ...], dict[str, object]]


class Pipe(Protocol):
    """The way to a share: it takes calls one at a time and answers each."""

    def send(self, call: Call, /) -> None:
        """Begin a call."""

    def recv(self) -> Any:
        """Return the answer, once it is there."""

    def close(self) -> None:
        """End what is at the other end, once the last call has been answered."""


class SharesVecEnv(VecEnv):
    """Environments in shares of several each.

    Environment ``i`` gets the same seed, actions and calls as in Stable-Baselines3's
    ``DummyVecEnv`` and ``SubprocVecEnv``, so that the number of shares changes no result.

    Args:
        pipes: One for each share.
        shares: Indices of the environments of each share; all together count up from 0.
        observation_space: Of each environment.
        action_space: Of each environment.
    """

    def __init__(
        self,
        pipes: Sequence[Pipe],
        shares: Sequence[np.ndarray],
        observation_space: gym.Space,
        action_space: gym.Space,
    ) -> None:
        self._pipes, self._shares = pipes, shares
        self._closed = self._waiting = False
        super().__init__(sum(map(len, shares)), observation_space, action_space)

    def reset(self) -> VecEnvObs:
        """Reset all environments, with their seeds and options where some have been set."""
        for pipe, share in zip(self._pipes, self._shares, strict=True):
            seeds, options = ([given[i] for i in share] for given in (self._seeds, self._options))
            pipe.send(("begin", (seeds, options), {}))
        observations, infos = zip(*self._answers(), strict=True)
        self.reset_infos = list(chain(*infos))
        self._reset_seeds()
        self._reset_options()
        return _joined(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step."""
        for pipe, share in zip(self._pipes, self._shares, strict=True):
            pipe.send(("advance", (actions[share[0] : share[-1] + 1],), {}))
        self._waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step."""
        self._waiting = False  # also where an answer is an error
        answers = self._answers()
        observations, rewards, dones, infos, reset_infos = zip(*answers, strict=True)
        self.reset_infos = list(chain(*reset_infos))
        joined = map(_joined, (observations, rewards, dones))
        return *joined, list(chain(*infos))

    def close(self) -> None:
        """Close the environments and end what holds them."""
        if self._closed:
            return
        if self._waiting:
            self._answers()
        self._closed = True
        try:
            self._ask_all("close")
        finally:
            for pipe in self._pipes:
                pipe.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return the scene of each environment."""
        return list(chain(*self._ask_all("get_images")))

    def has_attr(self, attr_name: str) -> bool:
        """Return whether all environments have an attribute."""
        return all(self._ask_all("has_attr", attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the chosen environments, by default of all."""
        return self._ask("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the chosen environments."""
        self._ask("set_attr", indices, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the chosen environments."""
        return self._ask("env_method", indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Tell which of the chosen environments have a wrapper."""
        return self._ask("env_is_wrapped", indices, wrapper_class)

    def _ask(
        self, method: str, indices: VecEnvIndices, *arguments: object, **keywords: object
    ) -> list[Any]:
        """Call a method of those shares that have chosen environments; answers in their order."""
        chosen = list(self._get_indices(indices))
        asked = []
        for pipe, share in zip(self._pipes, self._shares, strict=True):
            mine = [int(i) for i in share if i in chosen]
            if mine:
                local = [i - int(share[0]) for i in mine]
                pipe.send((method, arguments, {**keywords, "indices": local}))
                asked.append((pipe, mine))
        answers: dict[int, Any] = {}
        for pipe, mine in asked:
            answers |= zip(mine, pipe.recv() or [None] * len(mine), strict=True)
        return [answers[i] for i in chosen]

    def _ask_all(self, method: str, *arguments: object) -> list[Any]:
        """Call a method of all shares."""
        for pipe in self._pipes:
            pipe.send((method, arguments, {}))
        return self._answers()

    def _answers(self) -> list[Any]:
        return [pipe.recv() for pipe in self._pipes]


class Share(DummyVecEnv):
    """The environments of one share, with answers that hold all that a step or reset says."""

    def begin(self, seeds: Sequence[int | None], options: Sequence[Info]) -> tuple[object, ...]:
        """Reset all; return observations and infos."""
        self._seeds, self._options = list(seeds), list(options)
        return self.reset(), self.reset_infos

    def advance(self, actions: np.ndarray) -> tuple[object, ...]:
        """Step all; return what a step returns, and the infos of resets.

        It does what ``step`` does without its copies: `RunEnv` gives infos that are nobody else's,
        and joining the shares copies the rest.
        """
        infos: list[Info] = []
        for i, env in enumerate(self.envs):
            observation, self.buf_rews[i], terminated, truncated, info = env.step(actions[i])
            info["TimeLimit.truncated"] = truncated and not terminated
            infos.append(info)
            self.buf_dones[i] = terminated or truncated
            if self.buf_dones[i]:
                info["terminal_observation"] = observation
                observation, self.reset_infos[i] = env.reset()
            self._save_obs(i, observation)
        observations = dict_to_obs(self.observation_space, self.buf_obs)
        return observations, self.buf_rews, self.buf_dones, infos, self.reset_infos


def _joined(parts: Sequence[Any]) -> Any:
    """Join what each share has answered: observations of any kind, rewards or dones.

    Shapes:
        parts: ``(n_envs of the share, ...)`` for each share and entry.
    """
    first = parts[0]
    if isinstance(first, dict):
        return {key: np.concatenate([part[key] for part in parts]) for key in first}
    if isinstance(first, tuple):
        return tuple(map(np.concatenate, zip(*parts, strict=True)))
    return np.concatenate(parts)
