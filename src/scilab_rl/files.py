"""Writing files so that a crash at any moment leaves the old content or the new, never a half."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import signal
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

# Tests set it to let a process end, or a disk fill up, at a place of their choice.
FAULT_VARIABLE = "SCILAB_FAULT"
_TEMPORARY = ".*.tmp"
_POLL_SECONDS = 0.005  # while a lock is waited for
_passed: Counter[str] = Counter()


def fault_point(name: str) -> None:
    """Do what ``SCILAB_FAULT`` asks for at this place; without it, nothing.

    ``checkpoint.after_tensors:3:SIGKILL`` ends the process when it passes here for the third time,
    ``metrics.before_line:1:ENOSPC`` lets the first line find the disk full.

    Args:
        name: Of the place.

    Raises:
        OSError: If an error is asked for.
    """
    wanted, _, rest = os.environ.get(FAULT_VARIABLE, "").partition(":")
    if wanted != name:
        return
    _passed[name] += 1
    count, _, action = rest.partition(":")
    if _passed[name] != int(count):
        return
    if action.startswith("SIG"):
        os.kill(os.getpid(), signal.Signals[action])
    else:
        number = getattr(errno, action)
        raise OSError(number, os.strerror(number))


def lock(file: IO[Any], *, wait: bool = True) -> bool:
    """Lock an open file until it is closed; the kernel drops the lock when the process dies.

    Args:
        file: An open file, for reading or writing.
        wait: Whether to wait for another process that holds the lock.

    Returns:
        Whether the lock is ours.

    Raises:
        OSError: If the drive has no locks.
    """
    from filelock import lock_descriptor  # 60 ms, which most commands can do without

    return lock_descriptor(file.fileno(), blocking=wait, poll_interval=_POLL_SECONDS)


def remove_unfinished(directory: Path) -> None:
    """Remove what a killed process was writing in this directory, which must be unused."""
    for abandoned in directory.glob(_TEMPORARY):
        if abandoned.is_dir() and not abandoned.is_symlink():
            shutil.rmtree(abandoned, ignore_errors=True)
        else:
            abandoned.unlink(missing_ok=True)


def discard(directory: Path) -> None:
    """Remove a directory that no other process uses.

    It is renamed first, so that one that is half removed cannot be taken for a whole one; what a
    process leaves that is killed meanwhile, `remove_unfinished` removes.
    """
    # Not the name under which its successor is being written.
    doomed = directory.with_name(f".{directory.name}.{os.getpid()}.old.tmp")
    with contextlib.suppress(OSError):
        directory.rename(doomed)
        fault_point("files.in_discarding")
    shutil.rmtree(doomed, ignore_errors=True)


def atomic_write(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file through a temporary neighbour that replaces it in one step.

    Args:
        path: The file to create or replace.
        write: Called with the open temporary file; writes the whole content.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        fault_point("file.before_replace")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    fsync_directory(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8 whatever the locale says."""
    atomic_write(path, lambda file: file.write(text.encode()))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, with keys in their given order."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def read_json_lines(path: Path, containing: str = "") -> list[dict[str, Any]]:
    """Return the objects of a JSONL file; none when it does not exist.

    A line that cannot be parsed is skipped: a killed run may have written half of the last one.

    Args:
        path: The file.
        containing: Lines without this text are skipped unread, which is much faster.
    """
    rows = []
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            if containing not in line:
                continue
            with contextlib.suppress(ValueError):
                rows.append(json.loads(line))
    return [row for row in rows if isinstance(row, dict)]


def fsync_directory(directory: Path) -> None:
    """Make a rename in this directory survive a power failure."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def point_to(link: Path, target: Path) -> None:
    """Let the relative symbolic link ``link`` point to ``target``, replacing an older one at once.

    Where links are not allowed (some network drives), nothing happens: a link is a convenience.
    """
    temporary = link.with_name(f".{link.name}.{os.getpid()}.tmp")
    try:
        temporary.symlink_to(os.path.relpath(target, link.parent))
        temporary.replace(link)
    except OSError:
        temporary.unlink(missing_ok=True)


def shown(path: Path) -> str:
    """Return a path as people type it: from the working directory where it is below it."""
    here, path = Path.cwd(), path.absolute()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
