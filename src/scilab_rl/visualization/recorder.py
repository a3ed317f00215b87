"""Keeping what is shown: one file per clip, and video, page and viewer recording made of it."""

from __future__ import annotations

import atexit
import logging
import queue
import threading
from collections.abc import Callable
from pathlib import Path

from scilab_rl.visualization.archive import SUFFIX, save_clip
from scilab_rl.visualization.develop import develop
from scilab_rl.visualization.records import Clip, ClipInfo, Record

_log = logging.getLogger(__name__)


class ClipRecorder:
    """Collects records and writes each clip while training goes on.

    Args:
        folder: Where the files go; made when the first clip is written.
        on_file: Called with each finished video and page, from another thread.
    """

    def __init__(self, folder: Path, on_file: Callable[[Path], object] | None = None) -> None:
        self.folder = folder
        self.on_file = on_file
        self.recordings: list[Path] = []
        self._has_warned = False
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
            n, run = len(self.recordings), self.folder.parent
            _log.info("Recorded episodes: %d. Look at them with: scilab-rl view %s", n, run)

    def _work(self) -> None:
        while (clip := self._finished.get()) is not None:
            try:
                self._write(clip)
            except (OSError, RuntimeError) as error:
                self._warn_once(clip.info.name, error)

    def _warn_once(self, name: str, error: Exception) -> None:
        """Say what is wrong with a recording; what comes later has most likely the same cause."""
        if not self._has_warned:
            self._has_warned = True
            _log.warning(
                "Recording %s: %s. Training goes on; further failures of this kind are not told.",
                name,
                error,
            )

    def _write(self, clip: Clip) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{clip.info.name}{SUFFIX}"
        save_clip(clip, path)
        self.recordings.append(path)
        for finished in develop(path):
            if self.on_file is not None:
                self.on_file(finished)
