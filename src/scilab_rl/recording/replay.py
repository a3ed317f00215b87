"""An episode as one HTML file that needs no server, no network and no program but a browser."""

from __future__ import annotations

from pathlib import Path

from scilab_rl import files
from scilab_rl.pages import data_address, media_type, render
from scilab_rl.recording.records import Clip, title_of, value_range


def write_replay(clip: Clip, path: Path) -> None:
    """Write a clip as a page with scene, curves, scrubber and keyboard."""
    files.write_text(path, render("replay.html", clip=_content(clip)))


def _content(clip: Clip) -> dict[str, object]:
    info, records = clip.info, clip.records
    return {
        "env": info.env_id,
        "algorithm": info.algorithm,
        "about": info.place(records[0].episode),
        "fps": info.fps,
        "small": any(media_type(record.picture) == "image/png" for record in records),
        "steps": [record.step for record in records],
        "episodes": [record.episode for record in records],
        "last": [record.is_last_scene for record in records],
        "events": [
            [event for event in record.events if event != "episode start"] for record in records
        ],
        "panels": [_panel(clip, name) for name in info.panels],
        "pictures": [data_address(record.picture) for record in records],
    }


def _panel(clip: Clip, name: str) -> dict[str, object]:
    curves = clip.curves(name)
    return {
        "name": title_of(name),
        "range": value_range(list(curves.values())),
        "curves": [{"label": label, "values": values} for label, values in curves.items()],
    }
