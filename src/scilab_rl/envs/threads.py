"""A vector environment in which a few threads of one process share many environments.

MuJoCo computes without Python's lock, so that the simulations of several threads run side by side;
what is Python in a step still takes turns. Compared with processes, nothing is copied from one to
another. Each environment is made, stepped, drawn and closed in one thread only, and the first of
them in the main thread, as OpenGL requires.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.envs.shares import Call, Share, SharesVecEnv

Maker = Callable[[], gym.Env]


class ThreadsVecEnv(SharesVecEnv):
    """Environments that live in this process and are stepped by several threads.

    Only for environments that share nothing: their chance must come from their own ``np_random``.

    Args:
        makers: One function per environment that makes it.
        n_threads: Number of threads, the one that calls included; their shares differ by one
            environment at most.
    """

    def __init__(self, makers: Sequence[Maker], n_threads: int) -> None:
        shares = np.array_split(np.arange(len(makers)), n_threads)
        # One after the other: registering and importing are not made for threads.
        first = _ThisThread([makers[i] for i in shares[0]])
        others = [_OtherThread([makers[i] for i in share]) for share in shares[1:]]
        spaces = first.share.observation_space, first.share.action_space
        super().__init__([first, *others], shares, *spaces)


class _ThisThread:
    """A share in the thread that asks for answers: it works when it is asked for one."""

    def __init__(self, makers: list[Maker]) -> None:
        self.share = Share(makers)
        self._call: Callable[[], object] | None = None

    def send(self, call: Call) -> None:
        self._call = _bound(self.share, call)

    def recv(self) -> Any:
        call, self._call = self._call, None
        return call() if call else None

    def close(self) -> None:
        pass


class _OtherThread:
    """A share in a thread of its own."""

    def __init__(self, makers: list[Maker]) -> None:
        self._thread = ThreadPoolExecutor(1, "environments")
        self.share = self._thread.submit(Share, makers).result()
        self._answer: Future[object] | None = None

    def send(self, call: Call) -> None:
        self._answer = self._thread.submit(_bound(self.share, call))

    def recv(self) -> Any:
        answer, self._answer = self._answer, None
        return answer.result() if answer else None

    def close(self) -> None:
        self._thread.shutdown()


def _bound(share: Share, call: Call) -> Callable[[], object]:
    method, arguments, keywords = call
    return partial(getattr(share, method), *arguments, **keywords)
