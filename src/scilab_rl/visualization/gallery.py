"""Keeping only the moments that matter, and one page that ranks them."""

from __future__ import annotations

import base64
import html
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scilab_rl import files
from scilab_rl.metrics.triggers import Trigger
from scilab_rl.visualization.recorder import ClipRecorder
from scilab_rl.visualization.records import Clip, ClipInfo, Record, media_type

_log = logging.getLogger(__name__)
SECONDS_AROUND = 2.0
MOST_MOMENTS = 60  # in the gallery; the others stay in their folder
GALLERY = "gallery.html"


@dataclass(frozen=True)
class Moment:
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


class MomentRecorder:
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
        self.moments: list[Moment] = []
        self._clip: Clip | None = None
        self._seen: list[float] = []

    def begin(self, clip: ClipInfo) -> None:
        """Begin a clip."""
        self._clip = Clip(clip)

    def add(self, record: Record) -> None:
        """Look at a scene."""
        assert self._clip is not None
        self._clip.records.append(record)
        if self.trigger.metric in record.values:
            self._seen.append(record.values[self.trigger.metric])

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
        if not self.moments:
            return
        try:
            self._write_gallery()
        except OSError as error:
            _log.warning("The gallery could not be written: %s.", error)

    def _peaks(self, clip: Clip, around: int) -> list[tuple[int, float]]:
        """Return the best scene of each moment; those in its neighbourhood belong to it."""
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
        self.moments.append(Moment(score, record, name, index - first))

    def _write_gallery(self) -> None:
        ranked = sorted(self.moments, key=lambda moment: -moment.score)[:MOST_MOMENTS]
        cards = "\n".join(_card(rank, moment) for rank, moment in enumerate(ranked, start=1))
        title = html.escape(self.trigger.text)
        page = self.recorder.folder / GALLERY
        files.write_text(page, _PAGE.format(title=title, n=len(self.moments), cards=cards))
        if self.on_gallery is not None:
            self.on_gallery(page)


def _card(rank: int, moment: Moment) -> str:
    record = moment.record
    picture = base64.b64encode(record.picture).decode()
    return (
        f'<a class="card" href="{moment.clip}.html#{moment.position}">'
        f'<img src="data:{media_type(record.picture)};base64,{picture}" alt="">'
        f"<div><b>{rank}</b> score {moment.score:.4g}<br><span>{record.phase}, "
        f"episode {record.episode}, step {record.step}</span></div></a>"
    )


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>
<style>
:root {{ color-scheme: light dark;
  --page: #f6f6f8; --card: #fff; --ink: #18181b; --soft: #71717a; }}
@media (prefers-color-scheme: dark) {{
  :root {{ --page: #111114; --card: #1b1b1f; --ink: #f4f4f5; --soft: #a1a1aa; }}
}}
body {{ margin: 0; padding: 20px 24px 32px; background: var(--page); color: var(--ink);
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", sans-serif; }}
h1 {{ font-size: 18px; margin: 0 0 2px; }} p, span {{ color: var(--soft); margin: 0 0 16px; }}
main {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(210px, 1fr)); gap: 16px; }}
.card {{ background: var(--card); border-radius: 12px; overflow: hidden; color: inherit;
  text-decoration: none; box-shadow: 0 1px 2px rgb(0 0 0 / .08), 0 4px 16px rgb(0 0 0 / .06); }}
.card:hover {{ outline: 2px solid #2563eb; }}
.card div {{ padding: 10px 14px 12px; font-variant-numeric: tabular-nums; }}
img {{ width: 100%; aspect-ratio: 1; object-fit: cover; display: block; }}
</style></head><body>
<h1>{title}</h1><p>{n} moments, the strongest first. Each opens its replay.</p>
<main>
{cards}
</main></body></html>
"""
