"""Keeping only the highlights that matter, and one page that ranks them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scilab_rl import files
from scilab_rl.metrics.probes import Curve
from scilab_rl.metrics.triggers import Trigger
from scilab_rl.pages import render
from scilab_rl.recording.recorder import ClipRecorder
from scilab_rl.recording.records import Clip, ClipInfo, Record

_log = logging.getLogger(__name__)
SECONDS_AROUND = 2.0
MOST_HIGHLIGHTS = 60  # in the gallery; the others stay in their folder
HIGHLIGHTS = "highlights.html"


@dataclass(frozen=True)
class Highlight:
    """A scene that met the condition.

    Attributes:
        score: How strongly.
        record: The scene.
        clip: Name of the clip that holds it.
        position: Its place in that clip.
    """

    score: float
    record: Record
    clip: str
    position: int


class HighlightRecorder:
    """Watches clips and keeps the two seconds around each scene that meets a condition.

    Args:
        recorder: Writes the excerpts; the gallery goes to its folder.
        trigger: The condition.
        on_gallery: Called with the page after each change.
    """

    def __init__(
        self,
        recorder: ClipRecorder,
        trigger: Trigger,
        on_gallery: Callable[[Path], object] | None = None,
    ) -> None:
        self.recorder = recorder
        self.trigger = trigger
        self.on_gallery = on_gallery
        self.highlights: list[Highlight] = []
        self._clip: Clip | None = None
        self._seen: list[float] = []

    def begin(self, clip: ClipInfo) -> None:
        """Begin a clip."""
        self._clip = Clip(clip)

    def add(self, record: Record) -> None:
        """Look at a scene."""
        assert self._clip is not None
        self._clip.records.append(record)
        if (value := record.values.get(Curve(self.trigger.metric or ""))) is not None:
            self._seen.append(value)

    def end(self) -> None:
        """Keep what meets the condition."""
        assert self._clip is not None
        clip, self._clip = self._clip, None
        around = round(SECONDS_AROUND * clip.info.fps)
        for index, score in self._peaks(clip, around):
            self._keep(clip, index, score, around)

    def close(self) -> None:
        """Write the gallery."""
        self.recorder.close()
        if not self.highlights:
            return
        try:
            self._write_gallery()
        except OSError as error:
            _log.warning("The gallery could not be written: %s.", error)

    def _peaks(self, clip: Clip, around: int) -> list[tuple[int, float]]:
        """Return the best scene of each highlight; those in its neighbourhood belong to it."""
        seen = np.array(self._seen)
        scores = [self.trigger.score(r.values, r.events, seen) for r in clip.records]
        ranked = sorted(
            ((score, index) for index, score in enumerate(scores) if score is not None),
            key=lambda entry: (-entry[0], entry[1]),
        )
        peaks: list[tuple[int, float]] = []
        for score, index in ranked:
            if all(abs(index - other) > around for other, _ in peaks):
                peaks.append((index, score))
        return sorted(peaks)

    def _keep(self, clip: Clip, index: int, score: float, around: int) -> None:
        record = clip.records[index]
        name = f"{clip.info.name}_moment_{record.step:04d}"
        self.recorder.begin(replace(clip.info, name=name))
        first = max(0, index - around)
        for scene in clip.records[first : index + around + 1]:
            self.recorder.add(scene)
        self.recorder.end()
        self.highlights.append(Highlight(score, record, name, index - first))

    def _write_gallery(self) -> None:
        ranked = sorted(self.highlights, key=lambda highlight: -highlight.score)[:MOST_HIGHLIGHTS]
        page = self.recorder.folder / HIGHLIGHTS
        content = {"title": self.trigger.text, "n": len(self.highlights), "highlights": ranked}
        files.write_text(page, render("highlights.html", **content))
        if self.on_gallery is not None:
            self.on_gallery(page)
