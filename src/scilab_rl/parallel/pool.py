"""Worker processes that are started once, take a run whenever they are free, and are replaced."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType

from scilab_rl.machine import n_cores
from scilab_rl.parallel import worker
from scilab_rl.parallel.worker import Message, Task


@dataclass
class Worker:
    """One process of the pool.

    Attributes:
        process: The process.
        connection: Our end of its pipe.
        job: Number of the run that it trains, or None when it is free.
        busy_since: Monotonic time, in seconds, at which that run was given to it.
    """

    process: BaseProcess
    connection: Connection
    job: int | None = None
    busy_since: float = 0.0


class Pool:
    """A number of workers on this machine.

    Args:
        size: Most workers at the same time.
        log_dir: Folder for what they print.
        main: What a worker does; the same protocol as `worker.main`.
    """

    def __init__(
        self, size: int, log_dir: Path, main: Callable[[Connection, str, int], None] = worker.main
    ) -> None:
        self.size = size
        self.log_dir = log_dir
        self.main = main
        self.n_threads = max(1, n_cores() // size)
        self._workers: list[Worker] = []
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> Pool:
        self.log_dir.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        for one in self._workers:
            if one.job is None:
                one.connection.close()  # it is waiting for work and now ends by itself
            else:
                one.process.kill()
        for one in self._workers:
            one.process.join(5)
            if one.process.is_alive():
                one.process.kill()

    @property
    def n_busy(self) -> int:
        """Workers that train a run."""
        return sum(one.job is not None for one in self._workers)

    def has_room(self) -> bool:
        """Return whether another run can begin at once."""
        return self.n_busy < self.size

    def submit(self, job: int, task: Task) -> None:
        """Give a run to a free worker, started now if need be.

        Args:
            job: Number of the run.
            task: What to train.
        """
        free = next((one for one in self._workers if one.job is None), None) or self._start()
        free.job, free.busy_since = job, time.monotonic()
        try:
            free.connection.send(task)
        except OSError:  # it died while it was idle; its end comes as a message
            free.process.kill()

    def answer(self, job: int, go_on: bool) -> None:
        """Answer an evaluation."""
        for one in self._workers:
            if one.job == job:
                try:
                    one.connection.send(go_on)
                except OSError:
                    return  # it has died meanwhile; its end comes as a message

    def messages(self, timeout: float) -> list[tuple[int, Message]]:
        """Wait for news and return them, each with the number of its run.

        Args:
            timeout: Seconds to wait at most.
        """
        by_connection = {one.connection: one for one in self._workers}
        news = []
        for ready in wait(list(by_connection), timeout):
            one = by_connection[ready]  # type: ignore[index]
            job = one.job
            try:
                message = one.connection.recv()
            except (EOFError, OSError):
                message = Message("died", {"error": self._reap_worker(one)})
            if message.kind in worker.LAST_WORDS:
                one.job = None
            if job is not None and message.kind != "ready":
                news.append((job, message))
        return news

    def give_sign(self) -> None:
        """Show that the study continues; workers of this process see it anyway."""

    def kill_older_than(self, seconds: float) -> list[int]:
        """Kill the workers that have trained one run for longer, and return their runs."""
        late = [
            one
            for one in self._workers
            if one.job is not None and time.monotonic() - one.busy_since > seconds
        ]
        jobs = [one.job for one in late if one.job is not None]
        for one in late:
            one.process.kill()
            self._reap_worker(one)
            one.job = None
        return jobs

    def kill_all(self) -> None:
        """Kill all workers at once."""
        for one in list(self._workers):
            one.process.kill()
            self._reap_worker(one)

    def _start(self) -> Worker:
        ours, theirs = self._context.Pipe()
        log = self.log_dir / f"worker-{os.getpid()}-{len(self._workers)}.log"
        # No daemon: a run may have environment processes of its own.
        process = self._context.Process(target=self.main, args=(theirs, str(log), self.n_threads))
        process.start()
        theirs.close()
        self._workers.append(Worker(process, ours))
        return self._workers[-1]

    def _reap_worker(self, one: Worker) -> str:
        """Remove a dead worker and return how it died."""
        one.process.join(5)
        code = one.process.exitcode
        one.connection.close()
        self._workers.remove(one)
        if code is not None and code < 0:
            hint = ", maybe out of memory" if -code == signal.SIGKILL else ""
            return f"the worker was killed by {signal.Signals(-code).name}{hint}"
        return f"the worker ended with exit code {code}"
