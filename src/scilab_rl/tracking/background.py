"""Trackers that may fail, be slow or hang, without the training noticing."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from scilab_rl.errors import first_line
from scilab_rl.results import RunResult
from scilab_rl.tracking.base import SyncableTracker, TrackedRun, Tracker

_log = logging.getLogger(__name__)
_LOOK_SECONDS = 0.5
_AT_WORK = 0.01  # share of a processor above which a tracker does not hang
_MOST_PATIENCE = 10  # times the patience, whatever it works at


class BackgroundTracker(Tracker):
    """Feeds a tracker from a thread of its own, through a bounded queue.

    After ``max_failures`` failures in a row the tracker is switched off with one warning; what it
    missed is complete in the run's own files.

    Args:
        tracker: The tracker to feed.
        label: Its name in the warning.
        queue_size: Most waiting messages; further ones are dropped.
        max_failures: Failures in a row until it is switched off.
        patience_seconds: How long the end of a run waits for a tracker that does nothing. One that
            is at work, as many are that start at the same time, gets ten times as much.
    """

    def __init__(
        self,
        tracker: Tracker,
        label: str,
        *,
        queue_size: int = 10_000,
        max_failures: int = 3,
        patience_seconds: float = 60.0,
    ) -> None:
        self.tracker = tracker
        self.label = label
        self.max_failures = max_failures
        self.patience_seconds = patience_seconds
        self._messages: queue.Queue[Callable[[], object] | None] = queue.Queue(queue_size)
        self._thread = threading.Thread(target=self._work, name=f"{label} tracker", daemon=True)
        self._failures = 0
        self._off = False
        self._closing: Callable[[], object] | None = None
        self._clock: int | None = None  # of the thread's processor time

    def begin(self, run: TrackedRun) -> None:
        """Start the thread; the tracker itself is opened there."""
        self._thread.start()
        self._put(lambda: self.tracker.begin(run))

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Queue an epoch."""
        copied = dict(values)
        self._put(lambda: self.tracker.epoch(step, epoch, copied))

    def artifact(self, path: Path) -> None:
        """Queue a file."""
        self._put(lambda: self.tracker.artifact(path))

    def end(self, result: RunResult) -> None:
        """Queue the end and wait a while for everything to be written."""
        self._closing = lambda: self.tracker.end(result)
        deadline = time.monotonic() + self.patience_seconds
        for message in (self._closing, None):
            self._put(message, max(0.0, deadline - time.monotonic()))
        waited = self._wait()
        if self._thread.is_alive():
            self._switch_off(f"it did not finish within {round(waited, 1):g} s")

    def _wait(self) -> float:
        """Wait for the thread to end, unless it hangs; return the seconds that it took."""
        started = now = time.monotonic()
        latest = started + _MOST_PATIENCE * self.patience_seconds
        end, worked = started + self.patience_seconds, self._processor_seconds()
        while self._thread.is_alive() and now < min(end, latest):
            self._thread.join(min(_LOOK_SECONDS, end - now))
            now = time.monotonic()
            if self._processor_seconds() - worked > _AT_WORK * self.patience_seconds:
                end, worked = now + self.patience_seconds, self._processor_seconds()
        return time.monotonic() - started

    def _processor_seconds(self) -> float:
        """Return how long the thread has computed; 0 where the system cannot tell."""
        try:
            return 0.0 if self._clock is None else time.clock_gettime(self._clock)
        except OSError:  # it has just ended
            return 0.0

    def _put(self, message: Callable[[], object] | None, patience_seconds: float = 0.0) -> None:
        try:
            self._messages.put(message, timeout=patience_seconds)
        except queue.Full:
            self._switch_off("it is too slow")

    def _work(self) -> None:
        opened = False
        if hasattr(time, "pthread_getcpuclockid"):
            self._clock = time.pthread_getcpuclockid(threading.get_ident())
        while (message := self._messages.get()) is not None:
            # A tracker that has been opened is closed, even after it was switched off.
            if self._off and not (opened and message is self._closing):
                continue
            try:
                message()
                opened, self._failures = True, 0
            except BaseException as error:  # noqa: BLE001 - some libraries even call sys.exit
                self._failures += 1
                if not opened or self._failures >= self.max_failures:
                    self._switch_off(first_line(error))

    def _switch_off(self, reason: str) -> None:
        if not self._off:
            self._off = True
            later = isinstance(self.tracker, SyncableTracker)
            _log.warning(
                "%s is switched off for this run: %s. Nothing is lost: all metrics are in the "
                "run's own files.%s",
                self.label,
                reason,
                f" Send them later: scilab-rl sync RUN --to {self.label}" if later else "",
            )
