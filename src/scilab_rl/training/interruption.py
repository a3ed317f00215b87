"""Graceful shutdown: the first signal requests a checkpoint, the second ends the process."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class TrainingInterrupted(Exception):
    """Training has stopped at a point from which it can be resumed.

    Args:
        signal_number: The signal that asked for it.
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"interrupted by {signal.Signals(signal_number).name}")
        self.signal_number = signal_number


class StopRequest:
    """Remembers the first signal.

    Attributes:
        signal_number: 0 as long as no stop is requested.
    """

    def __init__(self) -> None:
        self.signal_number = 0

    def __bool__(self) -> bool:
        return self.signal_number != 0

    def receive(self, number: int, frame: FrameType | None) -> None:
        """Note the first signal; end at once at the second."""
        if self:
            os._exit(128 + number)
        self.signal_number = number


@contextmanager
def graceful_shutdown() -> Iterator[StopRequest]:
    """Turn Ctrl-C and SIGTERM into a request while the block runs.

    Outside the main thread, where signals cannot be handled, the request stays empty.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    previous = {
        number: signal.signal(number, request.receive) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
