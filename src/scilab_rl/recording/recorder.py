"""Keeping what is shown: one file per clip, and video, page and viewer recording made of it.

These are made in a process of its own, ``python -m scilab_rl.recording.recorder FILE.npz``, at low
priority, so that training never waits for it and cannot be hurt by it.
"""

from __future__ import annotations

import atexit
import importlib.util
import logging
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from scilab_rl.files import shown
from scilab_rl.recording.movie import write_movie
from scilab_rl.recording.records import SUFFIX, Clip, ClipInfo, Record, load_clip, save_clip
from scilab_rl.recording.replay import write_index, write_replay
from scilab_rl.recording.viewer_stream import write_viewer_file

_log = logging.getLogger(__name__)
_WRITERS: dict[str, Callable[[Clip, Path], None]] = {
    ".html": write_replay,
    ".mp4": write_movie,
    ".rrd": write_viewer_file,
}
_POLITE = 10
_PATIENCE = 600  # seconds


class ClipRecorder:
    """Collects records and writes each clip during training.

    Args:
        folder: Where the files go; made when the first clip is written.
        on_file: Called with each finished video and page, from another thread.
    """

    def __init__(self, folder: Path, on_file: Callable[[Path], object] | None = None) -> None:
        self.folder = folder
        self.on_file = on_file
        self.recordings: list[Path] = []
        self._clip: Clip | None = None
        self._finished: queue.SimpleQueue[Clip | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def begin(self, clip: ClipInfo) -> None:
        """Begin a clip."""
        self._clip = Clip(clip)

    def add(self, record: Record) -> None:
        """Keep a scene."""
        assert self._clip is not None
        self._clip.records.append(record)

    def end(self) -> None:
        """Hand the clip over to the writing thread."""
        clip, self._clip = self._clip, None
        if clip is None or not any(record.action is not None for record in clip.records):
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
            self._thread.start()
            atexit.register(self.close)  # a program that ends waits for its last clip
        self._finished.put(clip)

    def close(self) -> None:
        """Wait until all clips are written."""
        if self._thread is not None:
            atexit.unregister(self.close)
            self._finished.put(None)
            self._thread.join()
            self._thread = None
            n, run = len(self.recordings), shown(self.folder.parent)
            _log.info("Recorded episodes: %d. View them with: scilab-rl view %s", n, run)

    def _work(self) -> None:
        has_warned = False
        while (clip := self._finished.get()) is not None:
            try:
                self._write(clip)
            except (OSError, RuntimeError) as error:
                if not has_warned:  # what comes later has most likely the same cause
                    _log.warning(
                        "Recording %s: %s. Training continues; further such failures are not "
                        "reported.", clip.info.name, error,
                    )  # fmt: skip
                has_warned = True

    def _write(self, clip: Clip) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{clip.info.name}{SUFFIX}"
        save_clip(clip, path)
        self.recordings.append(path)
        for finished in render_clip_files(path):
            if self.on_file is not None:
                self.on_file(finished)


def render_clip_files(recording: Path) -> list[Path]:
    """Make video, page and viewer recording of an episode in a process of its own, and wait for it.

    Args:
        recording: The ``.npz`` file; the others get its name.

    Returns:
        The files that now exist.

    Raises:
        RuntimeError: If one of them could not be written, with the reason in one line.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, str(recording)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=_PATIENCE,
            start_new_session=True,  # Ctrl-C ends the training, the last episode is still written
        )
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"video and page were not finished after {_PATIENCE} s") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise RuntimeError(lines[-1])
    return [path for suffix in _WRITERS if (path := recording.with_suffix(suffix)).is_file()]


def main(arguments: Sequence[str]) -> int:
    """Make the files of some recordings and return 1 if any is missing."""
    if hasattr(os, "nice"):
        os.nice(_POLITE)
    failures = []
    for name in arguments:
        recording = Path(name)
        clip = load_clip(recording)
        for suffix, write in _WRITERS.items():
            if suffix == ".rrd" and importlib.util.find_spec("rerun") is None:
                continue  # the viewer is optional
            path = recording.with_suffix(suffix)
            try:
                write(clip, path)
            except Exception as error:  # noqa: BLE001 - the other files can still be made
                path.unlink(missing_ok=True)  # a part of it would look like the whole
                failures.append(f"{suffix} could not be written: {error}")
    for folder in {Path(name).parent for name in arguments}:
        try:
            write_index(folder)
        except OSError as error:
            failures.append(f"the list of episodes could not be written: {error}")
    sys.stderr.write("; ".join(" ".join(failure.split()) for failure in failures))
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
