"""Episodes on disk: everything that was recorded, in one file without pickle.

The file is the truth: video, page and viewer recording are made from it, and new questions are put
to it later (`scilab-rl probe`).
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl import files
from scilab_rl.errors import ConfigError
from scilab_rl.visualization.records import Clip, ClipInfo, Record

SUFFIX = ".npz"
FOLDER = "episodes"
_FORMAT = 1
_UNKNOWN = -1  # success in tasks without such a notion
_NUMBERS = ("env", "episode", "step", "total_steps")
_FLAGS = ("terminated", "truncated")


def save_clip(clip: Clip, path: Path) -> None:
    """Write a clip.

    The file holds, with one row per scene: ``observation`` or ``observation.<key>``, ``action`` and
    ``reward`` (NaN in the last scene of an episode), ``terminated``, ``truncated``, ``success``
    (-1: unknown), ``episode``, ``step``, ``total_steps``, ``state`` (MuJoCo's integration state),
    ``value.<curve>`` (NaN: gap), ``picture`` with ``picture_ends``; and ``about`` as JSON.
    """
    arrays: dict[str, Any] = _arrays(clip)
    files.atomic_write(path, lambda file: np.savez_compressed(file, **arrays))


def load_clip(path: Path) -> Clip:
    """Read a clip.

    Raises:
        ConfigError: If the file is no recorded episode.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            return _clip({name: stored[name] for name in stored.files})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"'{path}' is no recorded episode: {error}") from error


def _arrays(clip: Clip) -> dict[str, np.ndarray]:
    records = clip.records
    about = {
        "format": _FORMAT,
        "info": dataclasses.asdict(clip.info),
        "phases": [record.phase for record in records],
        "events": [record.events for record in records],
    }
    arrays = {
        "about": np.array(json.dumps(about)),
        "picture": np.frombuffer(b"".join(record.picture for record in records), np.uint8),
        "picture_ends": np.cumsum([len(record.picture) for record in records]),
        "action": _actions(records),
        "reward": np.array([np.nan if r.reward is None else r.reward for r in records]),
        "success": np.array(
            [_UNKNOWN if r.success is None else r.success for r in records], np.int8
        ),
    }
    arrays |= {name: np.array([getattr(r, name) for r in records]) for name in _NUMBERS + _FLAGS}
    if isinstance(records[0].observation, dict):
        for key in records[0].observation:
            arrays[f"observation.{key}"] = np.array([r.observation[key] for r in records])
    else:
        arrays["observation"] = np.array([record.observation for record in records])
    if all(record.state is not None for record in records):
        arrays["state"] = np.array([record.state for record in records])
    for curve in dict.fromkeys(curve for record in records for curve in record.values):
        arrays[f"value.{curve}"] = np.array([r.values.get(curve, np.nan) for r in records])
    return arrays


def _actions(records: list[Record]) -> np.ndarray:
    known = next(record.action for record in records if record.action is not None)
    gap = np.full(known.shape, np.nan)
    return np.array([gap if record.action is None else record.action for record in records])


def _clip(arrays: dict[str, np.ndarray]) -> Clip:
    about = json.loads(str(arrays["about"]))
    if about["format"] != _FORMAT:
        raise ValueError(f"its format is {about['format']}, and this version reads {_FORMAT}")
    info = about["info"]
    clip = Clip(ClipInfo(**info | {"panels": tuple(info["panels"])}))
    data = arrays["picture"].tobytes()
    for index, end in enumerate(arrays["picture_ends"]):
        start = int(arrays["picture_ends"][index - 1]) if index else 0
        record = _record(arrays, index, data[start : int(end)])
        record.phase, record.events = about["phases"][index], about["events"][index]
        clip.records.append(record)
    return clip


def _record(arrays: dict[str, np.ndarray], index: int, picture: bytes) -> Record:
    reward, success = float(arrays["reward"][index]), int(arrays["success"][index])
    is_last_scene = bool(np.isnan(reward))
    values = {
        name.removeprefix("value."): float(array[index])
        for name, array in arrays.items()
        if name.startswith("value.") and not np.isnan(array[index])
    }
    numbers: dict[str, Any] = {name: int(arrays[name][index]) for name in _NUMBERS}
    numbers |= {name: bool(arrays[name][index]) for name in _FLAGS}
    return Record(
        phase="",
        picture=picture,
        observation=_observation(arrays, index),
        action=None if is_last_scene else arrays["action"][index],
        reward=None if is_last_scene else reward,
        success=None if success == _UNKNOWN else bool(success),
        state=arrays["state"][index] if "state" in arrays else None,
        values=values,
        **numbers,
    )


def _observation(arrays: dict[str, np.ndarray], index: int) -> Any:
    if "observation" in arrays:
        return arrays["observation"][index]
    return {
        name.removeprefix("observation."): array[index]
        for name, array in arrays.items()
        if name.startswith("observation.")
    }
