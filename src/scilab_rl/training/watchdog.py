"""Noticing that nothing happens any more, and where."""

from __future__ import annotations

import faulthandler
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)


@contextmanager
def watchdog(progress: Callable[[], Any], seconds: float, stack_file: Path) -> Iterator[None]:
    """Warn while the block runs and nothing goes on in it.

    A warning is all: only the user knows whether an environment hangs or a server is slow. Studies
    end such a run after its timeout.

    Args:
        progress: Returns something that changes as long as all is well.
        seconds: Time without a change until the warning; 0 switches it off.
        stack_file: Where it is written what each thread was doing then.
    """
    if seconds == 0:
        yield
        return
    done = threading.Event()
    arguments = (progress, seconds, stack_file, done)
    thread = threading.Thread(target=_watch, args=arguments, name="watchdog", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _watch(
    progress: Callable[[], Any], seconds: float, stack_file: Path, done: threading.Event
) -> None:
    last, since, told = progress(), time.monotonic(), False
    while not done.wait(seconds / 4):
        if (now := progress()) != last:
            last, since, told = now, time.monotonic(), False
        elif not told and time.monotonic() - since >= seconds:
            told = True
            _tell(seconds, stack_file)


def _tell(seconds: float, stack_file: Path) -> None:
    try:
        with stack_file.open("w") as file:
            faulthandler.dump_traceback(file)
        where = f"What it is doing is in '{stack_file}'."
    except OSError as error:
        where = f"What it is doing cannot be written: {error.strerror}."
    _log.warning("No step for %g s: does the environment hang? %s", seconds, where)
