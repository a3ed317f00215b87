"""A vector environment in which a few worker processes share many environments.

With a process per environment each step is a message and a change of processes. Here each worker
steps its share of the environments one after the other and answers once, which is faster where
there are more environments than cores (``benchmarks/scaling.py``).
"""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import CloudpickleWrapper, DummyVecEnv, VecEnv


class WorkersVecEnv(VecEnv):
    """Environments that live in worker processes, several in each.

    Environment ``i`` gets the same seed, actions and calls as in Stable-Baselines3's
    ``DummyVecEnv`` and ``SubprocVecEnv``, so that the number of workers changes no result.

    Args:
        makers: One function per environment that makes it.
        n_workers: Number of processes; their shares differ by one environment at most.
        start_method: Of the processes: ``forkserver``, ``spawn`` or ``fork``; None: ``forkserver``
            where the platform has it, else ``spawn``.

    Attributes:
        processes: The workers.
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], gym.Env]],
        n_workers: int,
        start_method: str | None = None,
    ) -> None:
        forkable = "forkserver" in multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context(
            start_method or ("forkserver" if forkable else "spawn")
        )
        self._shares = np.array_split(np.arange(len(makers)), n_workers)
        self._pipes, self.processes = [], []
        self._closed = self._waiting = False
        for share in self._shares:
            pipe, far_end = context.Pipe()
            wrapped = CloudpickleWrapper([makers[i] for i in share])
            process = context.Process(target=_serve, args=(far_end, pipe, wrapped), daemon=True)
            process.start()
            far_end.close()
            self._pipes.append(pipe)
            self.processes.append(process)
        self._pipes[0].send(("spaces", (), {}))
        super().__init__(len(makers), *self._pipes[0].recv())

    def reset(self) -> Any:
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

    def step_wait(self) -> Any:
        """Finish the step."""
        answers = self._answers()
        self._waiting = False
        observations, rewards, dones, infos, reset_infos = zip(*answers, strict=True)
        self.reset_infos = list(chain(*reset_infos))
        joined = map(_joined, (observations, rewards, dones))
        return *joined, list(chain(*infos))

    def close(self) -> None:
        """Close the environments and end the workers."""
        if self._closed:
            return
        if self._waiting:
            self._answers()
        self._ask_all("close")
        for process in self.processes:
            process.join()
        for pipe in self._pipes:
            pipe.close()
        self._closed = True

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return the scene of each environment."""
        return list(chain(*self._ask_all("get_images")))

    def has_attr(self, attr_name: str) -> bool:
        """Tell whether all environments have an attribute."""
        return all(self._ask_all("has_attr", attr_name))

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the chosen environments, by default of all."""
        return self._ask("get_attr", indices, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the chosen environments."""
        self._ask("set_attr", indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the chosen environments."""
        return self._ask("env_method", indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """Tell which of the chosen environments have a wrapper."""
        return self._ask("env_is_wrapped", indices, wrapper_class)

    def _ask(self, method: str, indices: Any, *arguments: Any, **keywords: Any) -> list[Any]:
        """Call a method of those workers that have chosen environments; answers in their order."""
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

    def _ask_all(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of all workers."""
        for pipe in self._pipes:
            pipe.send((method, arguments, {}))
        return self._answers()

    def _answers(self) -> list[Any]:
        return [pipe.recv() for pipe in self._pipes]


class _Share(DummyVecEnv):
    """The environments of one worker, with answers that hold all that a step or reset says."""

    def begin(self, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> Any:
        self._seeds, self._options = list(seeds), list(options)
        return self.reset(), self.reset_infos

    def advance(self, actions: np.ndarray) -> Any:
        return *self.step(actions), self.reset_infos

    def spaces(self) -> tuple[gym.Space, gym.Space]:
        return self.observation_space, self.action_space


def _serve(pipe: Any, main_end: Any, makers: CloudpickleWrapper) -> None:
    """Answer calls until the main process says close or is gone."""
    main_end.close()
    share = _Share(makers.var)
    method = ""
    while method != "close":
        try:
            method, arguments, keywords = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            break
        answer = getattr(share, method)(*arguments, **keywords)
        with contextlib.suppress(BrokenPipeError):  # the main process was killed meanwhile
            pipe.send(answer)


def _joined(parts: Sequence[Any]) -> Any:
    """Join what each worker has answered: observations of any kind, rewards or dones.

    Shapes:
        parts: ``(n_envs of the worker, ...)`` for each worker and entry.
    """
    first = parts[0]
    if isinstance(first, dict):
        return {key: np.concatenate([part[key] for part in parts]) for key in first}
    if isinstance(first, tuple):
        return tuple(map(np.concatenate, zip(*parts, strict=True)))
    return np.concatenate(parts)
