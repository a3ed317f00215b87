"""What is shown of an episode: one record per scene, with the numbers that belong to its frame.

Record ``t`` holds the scene and the observation ``o_t`` in which the agent chose its action, that
action ``a_t``, and the metrics of ``(o_t, a_t)``; reward, success and errors of that step are what
the action led to. An episode of ``T`` steps has ``T + 1`` records: the last one holds the scene in
which the episode ended, where nothing is done any more. So ``value`` and ``goal_distance`` reach to
the end, and what needs an action has a gap there.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

# Rewards, values and distances are in the task's own units.
_UNITS = {"entropy": "nats", "log_prob": "nats"}
_JPEG_QUALITY = 88
_FLAT = 5e-3  # smaller relative changes are drawn as none: four digits could not tell them apart
_SMALL_SIDE = 200  # pixels; small frames cost little without loss


@dataclass
class Record:
    """One scene.

    Attributes:
        phase: ``train`` or ``eval``.
        env: Index of the environment.
        episode: Number of the episode in this environment, from 0.
        step: Steps in the episode before this scene, from 0.
        total_steps: Steps of all environments before this scene.
        picture: The frame as JPEG or PNG.
        observation: What the agent saw.
        action: What it did; None in the last scene of an episode.
        reward: What that gave; None as above.
        terminated: Whether this step led to a terminal state.
        truncated: Whether the episode was cut off after this step.
        success: Whether this step led to success; None where the task has no such notion.
        state: The simulator's state in this scene, where it can be had.
        values: Curve to number; what is missing is a gap.
        events: What happened to be seen in this scene.
    """

    phase: str
    env: int
    episode: int
    step: int
    total_steps: int
    picture: bytes
    observation: Any
    action: np.ndarray | None = None
    reward: float | None = None
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    state: np.ndarray | None = None
    values: dict[str, float] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)

    @property
    def is_last_scene(self) -> bool:
        """Whether this is the scene in which an episode ended."""
        return self.action is None


@dataclass(frozen=True)
class ClipInfo:
    """What a clip is about.

    Attributes:
        name: Base name of its files.
        phase: ``train`` or ``eval``.
        epoch: Number of the epoch, from 1.
        env_id: Id of the environment.
        algorithm: Name of the algorithm.
        fps: Frames per second of the task.
        panels: Names of the metrics, one panel each.
    """

    name: str
    phase: str
    epoch: int
    env_id: str
    algorithm: str
    fps: float
    panels: tuple[str, ...]


@dataclass
class Clip:
    """A sequence of scenes, usually one episode."""

    info: ClipInfo
    records: list[Record] = field(default_factory=list)

    def curves(self, panel: str) -> dict[str, list[float | None]]:
        """Return the curves of a panel by label, one entry per scene; None is a gap.

        A metric with one number has the label ``""``, one with several has one per name.
        """
        names = [
            name
            for name in dict.fromkeys(curve for record in self.records for curve in record.values)
            if panel_of(name) == panel
        ]
        return {
            label_of(name): [record.values.get(name) for record in self.records]
            for name in sorted(names, key=_natural)
        }


def panel_of(curve: str) -> str:
    """Return the metric that a curve belongs to.

    >>> panel_of("q_values[1]")
    'q_values'
    """
    return re.sub(r"\[[^\]]*\]$", "", curve)


def title_of(panel: str) -> str:
    """Return what is written above a panel: its metric, with the unit where it has one.

    >>> title_of("entropy"), title_of("reward")
    ('entropy (nats)', 'reward')
    """
    return f"{panel} ({_UNITS[panel]})" if panel in _UNITS else panel


def label_of(curve: str) -> str:
    """Return the name of a curve inside its panel.

    >>> label_of("q_values[1]"), label_of("reward")
    ('1', '')
    """
    found = re.search(r"\[([^\]]*)\]$", curve)
    return found[1] if found else ""


def encode_picture(frame: np.ndarray) -> bytes:
    """Compress a frame: JPEG, or PNG for the small ones. Shapes: ``(height, width, 3)``, uint8."""
    from PIL import Image

    image, file = Image.fromarray(frame), io.BytesIO()
    if max(frame.shape[:2]) <= _SMALL_SIDE:
        image.save(file, "PNG", compress_level=1)
    else:
        image.save(file, "JPEG", quality=_JPEG_QUALITY)
    return file.getvalue()


def decode_picture(picture: bytes) -> np.ndarray:
    """Return the frame of a picture. Shapes: ``(height, width, 3)``, uint8."""
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return np.asarray(image.convert("RGB"))


def media_type(picture: bytes) -> str:
    """Return the media type of a picture."""
    return "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"


def value_range(curves: Sequence[Sequence[float | None]]) -> tuple[float, float]:
    """Return the range of an axis that holds all values, with some room.

    >>> value_range([[None]])
    (0.0, 1.0)
    """
    numbers = [number for curve in curves for number in curve if number is not None]
    if not numbers:
        return 0.0, 1.0
    low, high = min(numbers), max(numbers)
    room = 0.06 * (high - low)
    if high - low < _FLAT * max(abs(low), abs(high)) or high == low:
        room = max(0.1 * abs(high), 1e-9) if high else 0.5
    return low - room, high + room


def _natural(name: str) -> list[Any]:
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]
