"""Records as a stream for the Rerun viewer: scene on the left, curves on the right."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from scilab_rl.errors import MissingDependencyError
from scilab_rl.visualization.panels import COLOURS, grid
from scilab_rl.visualization.records import (
    Clip,
    ClipInfo,
    Record,
    label_of,
    media_type,
    panel_of,
    title_of,
)

APPLICATION = "scilab-rl"
PHASES = {"train": "training", "eval": "evaluation"}
_GAP = float("nan")
_PATIENCE = 60.0  # seconds for writing a file
_WHAT_IT_SAYS = "warn,re_quota_channel=error"  # that a viewer is slow is told once, by us


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
        self._curves: dict[str, list[str]] = {}  # panel -> curves, in the order of their scalars
        self._styled: dict[str, int] = {}
        self._info: ClipInfo | None = None

    def begin(self, info: ClipInfo) -> None:
        """Begin a clip; its curves are not joined with those of the last one."""
        self._info = info
        self._curves |= {panel: [] for panel in info.panels if panel not in self._curves}

    def add(self, record: Record, seconds: float | None = None) -> None:
        """Write a scene.

        Args:
            record: The scene; without a picture, its numbers.
            seconds: When it was, since 1970; None: now.
        """
        seconds = time.time() if seconds is None else seconds
        if record.step == 0 and self._n_scenes:
            self._leave_gap(record, seconds)
        self._set_times(record, seconds)
        if record.picture:
            picture = self.rerun.EncodedImage(
                contents=record.picture, media_type=media_type(record.picture)
            )
            self.recording.log("scene", picture)
        self._log_values(record.values)
        self.recording.log("about", self.rerun.TextDocument(self._about(record)))
        for event in record.events:
            self.recording.log("events", self.rerun.TextLog(f"{self._place(record)}: {event}"))
        self._n_scenes += 1

    def _set_times(self, record: Record, seconds: float) -> None:
        self.recording.set_time("step", sequence=self._n_scenes)
        self.recording.set_time("environment step", sequence=record.total_steps)
        self.recording.set_time("time", timestamp=seconds)

    def _leave_gap(self, record: Record, seconds: float) -> None:
        """Separate the curves of two episodes by a step without numbers."""
        self._set_times(record, seconds)
        self._log_values({})
        self._n_scenes += 1

    def _log_values(self, numbers: dict[str, float]) -> None:
        for curve in numbers:
            known = self._curves.setdefault(panel_of(curve), [])
            if curve not in known:
                known.append(curve)
        for panel, curves in self._curves.items():
            if self._styled.get(panel) != len(curves):
                self._style(panel, curves)
            values = [numbers.get(curve, _GAP) for curve in curves]
            self.recording.log(["metrics", panel], self.rerun.Scalars(values or [_GAP]))

    def _style(self, panel: str, curves: list[str]) -> None:
        self._styled[panel] = len(curves)
        colours = [_rgb(COLOURS[number % len(COLOURS)]) for number in range(len(curves))]
        names = [label_of(curve) or panel for curve in curves]
        if curves:
            lines = self.rerun.SeriesLines(colors=colours, names=names, widths=[1.8] * len(curves))
            self.recording.log(["metrics", panel], lines, static=True)

    def _about(self, record: Record) -> str:
        assert self._info is not None
        return f"{self._info.env_id} {self._info.algorithm}: {self._place(record)}"

    def _place(self, record: Record) -> str:
        assert self._info is not None
        phase = PHASES.get(record.phase, record.phase)
        return f"{phase}, epoch {self._info.epoch}, episode {record.episode}, step {record.step}"


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
    """Write a clip as ``.rrd``; its wall time runs at the task's frame rate."""
    rerun = import_rerun("to write recordings of the viewer")
    recording = rerun.RecordingStream(APPLICATION)
    recording.set_sinks(rerun.FileSink(str(path)), default_blueprint=layout(clip.info.panels))
    stream = ViewerStream(recording)
    stream.begin(clip.info)
    for index, record in enumerate(clip.records):
        stream.add(record, seconds=index / clip.info.fps)
    recording.flush(timeout_sec=_PATIENCE)
    recording.disconnect()


def _curve_view(rerun: Any, panel: str) -> Any:
    entity = rerun.new_entity_path(["metrics", panel])
    corner = rerun.blueprint.Corner2D.LeftTop
    return rerun.blueprint.TimeSeriesView(
        origin=entity, name=title_of(panel), plot_legend=rerun.blueprint.PlotLegend(corner=corner)
    )


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
