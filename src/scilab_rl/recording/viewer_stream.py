"""Records as a stream for the Rerun viewer: scene on the left, curves on the right."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from scilab_rl import files
from scilab_rl.drawing import COLORS
from scilab_rl.errors import MissingDependencyError
from scilab_rl.metrics.probes import Curve
from scilab_rl.pages import media_type
from scilab_rl.recording.movie import grid
from scilab_rl.recording.records import (
    Clip,
    ClipInfo,
    Record,
    title_of,
)

APPLICATION = "scilab-rl"
_GAP = float("nan")
_WHAT_IT_SAYS = "warn,re_quota_channel=error"  # a slow viewer is reported once, by us


def import_rerun(purpose: str) -> Any:
    """Import the viewer's package.

    Raises:
        MissingDependencyError: If it is not installed.
    """
    os.environ.setdefault("RUST_LOG", _WHAT_IT_SAYS)
    try:
        import rerun
    except ImportError as error:
        raise MissingDependencyError("rerun-sdk", "view", purpose) from error
    return rerun


class _Row(NamedTuple):
    """The content of one step of the viewer; without content, a gap."""

    step: int
    total_steps: int
    seconds: float
    picture: bytes = b""
    values: Mapping[Curve, float] = MappingProxyType({})
    events: Sequence[str] = ()
    place: str = ""


class ViewerStream:
    """Writes records to a recording of the viewer.

    Entities are ``scene``, ``metrics/<panel>``, ``events`` and ``about``. Timelines are ``step``
    (one per scene, growing over all episodes, with an empty one between two), ``environment step``
    and ``time``.

    Args:
        recording: A ``rerun.RecordingStream``.
    """

    def __init__(self, recording: Any) -> None:
        self.rerun = import_rerun("to show episodes")
        self.recording = recording
        self._n_scenes = 0
        self._curves: dict[str, list[Curve]] = {}  # panel -> curves, in the order of their scalars
        self._styled: dict[str, int] = {}
        self._info: ClipInfo

    def begin(self, info: ClipInfo) -> None:
        """Begin a clip; its curves are not joined with those of the last one."""
        self._info = info
        self._curves |= {panel: [] for panel in info.panels if panel not in self._curves}

    def add(self, records: Sequence[Record], seconds: Sequence[float]) -> None:
        """Write scenes; several at once cost less than one by one.

        Args:
            records: The scenes; of one without a picture, its numbers.
            seconds: When each was, since 1970.
        """
        rows = list(self._rows(records, seconds))
        self._send_values(rows)
        scenes = [row for row in rows if row.place]
        about = f"{self._info.env_id} {self._info.algorithm}"
        places = [f"{about}: {row.place}" for row in scenes]
        times = self._times(scenes)
        self.recording.send_columns("about", times, self.rerun.TextDocument.columns(text=places))
        pictures = [row for row in scenes if row.picture]
        if pictures:
            columns = self.rerun.EncodedImage.columns(
                blob=[row.picture for row in pictures],
                media_type=[media_type(row.picture) for row in pictures],
            )
            self.recording.send_columns("scene", self._times(pictures), columns)
        events = [(row, event) for row in scenes for event in row.events]
        if events:
            texts = [f"{row.place}: {event}" for row, event in events]
            times = self._times([row for row, _ in events])
            self.recording.send_columns("events", times, self.rerun.TextLog.columns(text=texts))

    def _rows(self, records: Sequence[Record], seconds: Sequence[float]) -> Iterator[_Row]:
        """Yield the rows of scenes, with an empty one between two episodes."""
        for record, when in zip(records, seconds, strict=True):
            if record.step == 0 and self._n_scenes:
                yield self._row(record.total_steps, when)
            place = f"{self._info.place(record.episode)}, step {record.step}"
            yield self._row(
                record.total_steps, when, record.picture, record.values, record.events, place
            )

    def _row(self, total_steps: int, seconds: float, *content: Any) -> _Row:
        self._n_scenes += 1
        return _Row(self._n_scenes - 1, total_steps, seconds, *content)

    def _times(self, rows: Sequence[_Row]) -> list[Any]:
        column = self.rerun.TimeColumn
        nanoseconds = np.array([row.seconds for row in rows]) * 1e9
        return [
            column("step", sequence=[row.step for row in rows]),
            column("environment step", sequence=[row.total_steps for row in rows]),
            column("time", timestamp=nanoseconds.astype("datetime64[ns]")),
        ]

    def _send_values(self, rows: Sequence[_Row]) -> None:
        for curve in dict.fromkeys(curve for row in rows for curve in row.values):
            known = self._curves.setdefault(curve.panel, [])
            if curve not in known:
                known.append(curve)
        times = self._times(rows)
        for panel, curves in self._curves.items():
            if self._styled.get(panel) != len(curves):
                self._style(panel, curves)
            shown = curves or [Curve(panel)]  # a gap until something is recorded
            numbers = [row.values.get(curve, _GAP) for row in rows for curve in shown]
            columns = self.rerun.Scalars.columns(scalars=numbers)
            entity = self.rerun.new_entity_path(["metrics", panel])
            self.recording.send_columns(entity, times, columns.partition([len(shown)] * len(rows)))

    def _style(self, panel: str, curves: list[Curve]) -> None:
        self._styled[panel] = len(curves)
        colors = [_rgb(COLORS[number % len(COLORS)]) for number in range(len(curves))]
        names = [curve.label or panel for curve in curves]
        if curves:
            lines = self.rerun.SeriesLines(colors=colors, names=names, widths=[1.8] * len(curves))
            self.recording.log(["metrics", panel], lines, static=True)


def layout(panels: Iterable[str]) -> Any:
    """Return the viewer's layout: scene left, one view per metric right, events below."""
    rerun = import_rerun("to show episodes")
    blueprint = rerun.blueprint
    names = list(dict.fromkeys(panels))
    left = blueprint.Vertical(
        blueprint.Spatial2DView(origin="scene", name="Scene"),
        blueprint.TextDocumentView(origin="about", name="Now"),
        blueprint.TextLogView(origin="events", name="Events"),
        row_shares=[6, 1, 2],
    )
    views = [_curve_view(rerun, name) for name in names]
    content = left
    if views:
        columns = grid(len(views))[1]
        right = (
            blueprint.Grid(*views, grid_columns=columns)
            if columns > 1
            else blueprint.Vertical(*views)
        )
        content = blueprint.Horizontal(left, right, column_shares=[1, columns])
    return blueprint.Blueprint(
        content,
        blueprint.TimePanel(state="collapsed", timeline="step"),
        blueprint.BlueprintPanel(state="collapsed"),
        blueprint.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def write_viewer_file(clip: Clip, path: Path) -> None:
    """Write a clip as ``.rrd``; its wall time runs at the task's frame rate.

    Raises:
        OSError: If it could not be written, for example because the disk is full.
    """
    rerun = import_rerun("to write recordings of the viewer")
    recording = rerun.RecordingStream(APPLICATION)
    # Not into a file of its own making: on a full disk it may wait for ever.
    memory = recording.memory_recording()
    recording.send_blueprint(layout(clip.info.panels), make_active=False)
    stream = ViewerStream(recording)
    stream.begin(clip.info)
    stream.add(clip.records, [index / clip.info.fps for index in range(len(clip.records))])
    content = memory.drain_as_bytes()
    recording.disconnect()
    files.atomic_write(path, lambda file: file.write(content))


def _curve_view(rerun: Any, panel: str) -> Any:
    entity = rerun.new_entity_path(["metrics", panel])
    corner = rerun.blueprint.Corner2D.LeftTop
    return rerun.blueprint.TimeSeriesView(
        origin=entity, name=title_of(panel), plot_legend=rerun.blueprint.PlotLegend(corner=corner)
    )


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
