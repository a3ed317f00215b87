"""Runs as jobs of a scheduler, Ray or SLURM, behind the same interface as a pool of workers."""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Generic, Protocol, TypeVar

from scilab_rl.parallel import job, worker
from scilab_rl.parallel.worker import Message, Task

_POLL_SECONDS = 0.1
_SIGN_SECONDS = 5.0  # how often a study shows that it listens
_LAST_WORDS_SECONDS = 5.0  # a network drive may show the last message after the end of a job

Handle = TypeVar("Handle")


class Scheduler(Protocol[Handle]):
    """Starts jobs on other machines, or on this one."""

    def submit(self, folders: Sequence[Path]) -> list[Handle]:
        """Let `job.run` train what each folder describes, as soon as there is room.

        Returns:
            A handle of each job for the other methods.

        Raises:
            ScilabRLError: If the scheduler refuses them.
        """

    def end_of(self, handle: Handle) -> str | None:
        """Return how a job has ended, or None when it is queued or running."""

    def cancel(self, handle: Handle) -> None:
        """End a job at once, and for good."""

    def close(self) -> None:
        """Let go of the scheduler."""


@dataclass
class Job(Generic[Handle]):
    """A run that is queued or being trained.

    Attributes:
        number: Number of the run.
        folder: Where it exchanges messages with the study.
        handle: What the scheduler knows it by; None until it has been submitted.
        n_read: Bytes of its messages that have been read.
        since: Monotonic time, in seconds, of its first message; None while it is queued.
        ended: Monotonic time, in seconds, since which the scheduler says that it has ended.
    """

    number: int
    folder: Path
    handle: Handle | None = None
    n_read: int = 0
    since: float | None = None
    ended: float | None = None


class JobPool(Generic[Handle]):
    """As many jobs at the same time as wanted; each trains one run.

    Args:
        size: Most jobs at the same time, queued ones included.
        folder: Where the runs exchange messages with the study; all machines must see it.
        scheduler: What starts the jobs.
        n_threads: Threads of each run.
        function: What trains a run.
    """

    def __init__(
        self,
        size: int,
        folder: Path,
        scheduler: Scheduler[Handle],
        n_threads: int = 1,
        function: job.TrainFunction = worker.train,
    ) -> None:
        self.size = size
        self.folder = folder.resolve() / f"{os.getpid()}-{secrets.token_hex(4)}"
        self.scheduler = scheduler
        self.n_threads = n_threads
        self.function = function
        self._jobs: list[Job[Handle]] = []
        self._n_submitted = 0
        self._last_sign = 0.0

    def __enter__(self) -> JobPool:
        self.folder.mkdir(parents=True)
        self.give_sign()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.kill_all()
        self.scheduler.close()

    @property
    def n_busy(self) -> int:
        """Jobs that are queued or running."""
        return len(self._jobs)

    def has_room(self) -> bool:
        """Return whether another job may be submitted."""
        return self.n_busy < self.size

    def submit(self, number: int, task: Task) -> None:
        """Note a run for the scheduler, which gets all new ones together in `messages`.

        Args:
            number: Number of the run.
            task: What to train.
        """
        folder = self.folder / f"run-{number:06d}-{self._n_submitted}"
        self._n_submitted += 1
        job.write_task(folder, task, self.n_threads, self.function)
        self._jobs.append(Job(number, folder))

    def answer(self, number: int, go_on: bool) -> None:
        """Answer an evaluation."""
        for one in self._jobs:
            if one.number == number:
                job.write_answer(one.folder, go_on)

    def messages(self, timeout: float) -> list[tuple[int, Message]]:
        """Wait for news and return them, each with the number of its run.

        Args:
            timeout: Seconds to wait at most.
        """
        until = time.monotonic() + timeout
        if new := [one for one in self._jobs if one.handle is None]:
            handles = self.scheduler.submit([one.folder for one in new])
            for one, handle in zip(new, handles, strict=True):
                one.handle = handle
        while True:
            self.give_sign()
            news = [(one.number, message) for one in list(self._jobs) for message in self._ask(one)]
            if news or time.monotonic() > until:
                return news
            time.sleep(_POLL_SECONDS)

    def kill_older_than(self, seconds: float) -> list[int]:
        """End the jobs that have trained for longer, and return their runs."""
        now = time.monotonic()
        late = [one for one in self._jobs if one.since is not None and now - one.since > seconds]
        for one in late:
            self._cancel(one)
            self._jobs.remove(one)
        return [one.number for one in late]

    def kill_all(self) -> None:
        """End all jobs at once."""
        for one in self._jobs:
            with contextlib.suppress(Exception):  # each of the others must end too
                self._cancel(one)
        self._jobs.clear()

    def _cancel(self, one: Job[Handle]) -> None:
        if one.handle is not None:
            self.scheduler.cancel(one.handle)

    def _ask(self, one: Job[Handle]) -> list[Message]:
        messages, one.n_read = job.read_messages(one.folder, one.n_read)
        if not messages and (error := self._silent_end(one)) is not None:
            messages = [Message("died", {"error": error})]
            self._cancel(
                one
            )  # or its cluster could still start it again, in parallel with its repetition
        if messages and one.since is None:
            one.since = time.monotonic()
        if any(message.kind in worker.LAST_WORDS for message in messages):
            self._jobs.remove(one)
        return messages

    def _silent_end(self, one: Job[Handle]) -> str | None:
        """Return how a job has ended without a word, or None."""
        error = None if one.handle is None else self.scheduler.end_of(one.handle)
        if error is None:
            return None
        one.ended = one.ended or time.monotonic()
        return error if time.monotonic() - one.ended > _LAST_WORDS_SECONDS else None

    def give_sign(self) -> None:
        """Show the jobs that the study continues."""
        if time.monotonic() - self._last_sign > _SIGN_SECONDS:
            (self.folder / job.ALIVE).touch()
            self._last_sign = time.monotonic()
