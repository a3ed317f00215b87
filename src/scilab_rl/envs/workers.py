"""A vector environment in which a few worker processes share many environments.

With a process per environment each step is a message and a change of processes. Here each worker
steps its share of the environments one after the other and answers once, which is faster where
there are more environments than cores (``benchmarks/scaling.py``).
"""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import CloudpickleWrapper

from scilab_rl.envs.shares import Share, SharesVecEnv


class WorkersVecEnv(SharesVecEnv):
    """Environments that live in worker processes, several in each.

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
        shares = np.array_split(np.arange(len(makers)), n_workers)
        pipes: list[Connection] = []
        self.processes = []
        for share in shares:
            pipe, far_end = context.Pipe()
            wrapped = CloudpickleWrapper([makers[i] for i in share])
            process = context.Process(target=_serve, args=(far_end, pipe, wrapped), daemon=True)
            process.start()
            far_end.close()
            pipes.append(pipe)
            self.processes.append(process)
        answers = [pipe.recv() for pipe in pipes]
        for error in answers:
            if isinstance(error, Exception):
                raise error
        super().__init__(pipes, shares, *answers[0])

    def close(self) -> None:
        """Close the environments and end the workers."""
        super().close()
        for process in self.processes:
            process.join()


def _serve(pipe: Connection, main_end: Connection, makers: CloudpickleWrapper) -> None:
    """Answer calls until the main process says close or is gone."""
    main_end.close()
    try:
        share = Share(makers.var)
    except Exception as error:  # noqa: BLE001 - the main process raises it
        pipe.send(error)
        return
    pipe.send((share.observation_space, share.action_space))
    method = ""
    while method != "close":
        try:
            method, arguments, keywords = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            break
        answer = getattr(share, method)(*arguments, **keywords)
        with contextlib.suppress(BrokenPipeError):  # the main process was killed meanwhile
            pipe.send(answer)
