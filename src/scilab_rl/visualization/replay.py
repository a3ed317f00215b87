"""An episode as one HTML file that needs no server, no network and no program but a browser."""

from __future__ import annotations

import base64
import importlib.resources
import json
from pathlib import Path
from typing import Any

from scilab_rl import files
from scilab_rl.visualization.records import Clip, media_type, title_of, value_range

_DATA = "@CLIP@"
PHASES = {"train": "training", "eval": "evaluation"}


def write_replay(clip: Clip, path: Path) -> None:
    """Write a clip as a page with scene, curves, scrubber and keyboard."""
    page = importlib.resources.files(__package__).joinpath("replay.html").read_text("utf-8")
    # A name such as "</script>" must not end the data.
    data = json.dumps(_content(clip), allow_nan=False).replace("<", "\\u003c")
    files.write_text(path, page.replace(_DATA, data))


def _content(clip: Clip) -> dict[str, Any]:
    info, records = clip.info, clip.records
    phase = PHASES.get(info.phase, info.phase)
    return {
        "env": info.env_id,
        "algorithm": info.algorithm,
        "about": f"{phase}, epoch {info.epoch}, episode {records[0].episode}",
        "fps": info.fps,
        "small": media_type(records[0].picture) == "image/png",
        "steps": [record.step for record in records],
        "episodes": [record.episode for record in records],
        "last": [record.is_last_scene for record in records],
        "events": [
            [event for event in record.events if event != "episode start"] for record in records
        ],
        "panels": [_panel(clip, name) for name in info.panels],
        "pictures": [_address(record.picture) for record in records],
    }


def _panel(clip: Clip, name: str) -> dict[str, Any]:
    curves = clip.curves(name)
    return {
        "name": title_of(name),
        "range": value_range(list(curves.values())),
        "curves": [{"label": label, "values": values} for label, values in curves.items()],
    }


def _address(picture: bytes) -> str:
    return f"data:{media_type(picture)};base64,{base64.b64encode(picture).decode()}"
