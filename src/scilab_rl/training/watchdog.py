"""Noticing that nothing happens any more, and where."""

from __future__ import annotations

import faulthandler
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_log = logging.getLogger(__name__)


@contextmanager
def watchdog(progress: Callable[[], object], seconds: float, stack_file: Path) -> Iterator[None]:
    """Warn if nothing progresses while the block runs.

    A warning is all: only the user knows whether an environment hangs or a server is slow. Studies
    end such a run after its timeout. The stack is written even when a simulator holds the
    interpreter's lock, so that no Python thread runs; the warning then follows when it is released.

    Args:
        progress: Returns something that changes as long as all is well.
        seconds: Time without a change until the warning; 0 switches it off.
        stack_file: Where it is written what each thread was doing then; removed when it is empty.
    """
    if seconds == 0:
        yield
        return
    try:
        file = stack_file.open("ab")
    except OSError:
        file = Path(os.devnull).open("ab")
    done = threading.Event()
    arguments = (progress, seconds, file, done)
    thread = threading.Thread(target=_watch, args=arguments, name="watchdog", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        faulthandler.cancel_dump_traceback_later()
        if not _size(file):
            stack_file.unlink(missing_ok=True)
        file.close()


def _watch(
    progress: Callable[[], object], seconds: float, file: BinaryIO, done: threading.Event
) -> None:
    last, since, has_warned = object(), time.monotonic(), False  # nothing yet equals it
    while True:
        # The stack is written by now. Asked before the progress: both may have had to wait.
        if not has_warned and time.monotonic() - since > 1.1 * seconds:
            has_warned = True
            _tell(seconds, file)
        if (now := progress()) != last:
            last, since, has_warned = now, time.monotonic(), False
            faulthandler.dump_traceback_later(seconds, file=file)
        if done.wait(seconds / 4):
            return


def _tell(seconds: float, file: BinaryIO) -> None:
    where = f"is in '{file.name}'" if _size(file) else "cannot be written"
    _log.warning(
        "No step for %g s: does the environment hang? What it is doing %s.", seconds, where
    )


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size
