"""The recording of an episode: one record per scene, with the numbers of its frame.

Record ``t`` holds the scene and the observation ``o_t`` in which the agent chose its action, that
action ``a_t``, and the metrics of ``(o_t, a_t)``; reward, success and errors of that step are what
the action led to. An episode of ``T`` steps has ``T + 1`` records: the last one holds the scene in
which the episode ended, where nothing is done any more. So ``value`` and ``goal_distance`` reach to
the end, and what needs an action has a gap there.

On disk, a clip is one file without pickle. The file is the truth: video, page and viewer recording
are made from it, and new questions are put to it later (`scilab-rl probe`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl import files
from scilab_rl.drawing import number_text
from scilab_rl.errors import ConfigError
from scilab_rl.metrics.probes import Curve, Observation

SUFFIX = ".npz"
FOLDER = "episodes"
_FORMAT = 2
_UNKNOWN = -1  # success in tasks without such a notion
_NUMBERS = ("env", "episode", "step", "total_steps")
_FLAGS = ("terminated", "truncated")
# Rewards, values and distances are in the task's own units.
_UNITS = {"entropy": "nats", "log_prob": "nats"}
_WORDS = {"q_values": "critic", "action": "dimension"}  # what the numbers of a panel count
_RANGES = {"success": (0.0, 1.0)}
_SHOWN_SECONDS = 5.0  # at least, so that a short episode can be followed
_SLOWEST = 10.0  # frames per second
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
        picture: The frame as JPEG or PNG; empty where it could not be drawn.
        observation: What the agent saw.
        action: What it did; None in the last scene of an episode.
        reward: What that gave; None as above.
        terminated: Whether this step led to a terminal state.
        truncated: Whether the episode was cut off after this step.
        success: Whether this step led to success; None where the task has no such notion.
        state: The simulator's state in this scene, where it can be had.
        values: What is missing is a gap.
        events: What happened to be seen in this scene.
        start: In the first scene of an episode how it began, to repeat it: see
            `scilab_rl.envs.scenes.start_as_text`; elsewhere, or where it is unknown, empty.
    """

    phase: str
    env: int
    episode: int
    step: int
    total_steps: int
    picture: bytes
    observation: Observation
    action: np.ndarray | None = None
    reward: float | None = None
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    state: np.ndarray | None = None
    values: dict[Curve, float] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    start: str = ""

    @property
    def is_last_scene(self) -> bool:
        """Whether this is the scene in which an episode ended."""
        return self.action is None


@dataclass(frozen=True)
class ClipInfo:
    """The origin of a clip.

    Attributes:
        name: Base name of its files.
        phase: ``train`` or ``eval``.
        epoch: Number of the epoch, from 1.
        env_id: Id of the environment.
        algorithm: Name of the algorithm.
        fps: Frames per second of the task.
        panels: Names of the metrics, one panel each.
        run: Name of the run.
        seed: Of its environment; None where it is not known.
        policy: Which policy acts.
    """

    name: str
    phase: str
    epoch: int
    env_id: str
    algorithm: str
    fps: float
    panels: tuple[str, ...]
    run: str = ""
    seed: int | None = None
    policy: str = ""

    def place(self, episode: int) -> str:
        """Return where an episode of the clip belongs, as it is written next to its scenes."""
        phase = {"train": "training", "eval": "evaluation"}.get(self.phase, self.phase)
        epoch = f", epoch {self.epoch}" if self.epoch else ""  # a played policy has none
        return f"{phase}{epoch}, episode {episode}"


@dataclass(frozen=True)
class EpisodeOutcome:
    """How an episode of a clip went.

    Attributes:
        total_reward: The sum of its rewards.
        n_steps: Its length.
        success: Whether it ended in success; None where the task has no such notion.
        is_complete: Whether the clip holds it from its first to its last scene.
    """

    total_reward: float
    n_steps: int
    success: bool | None
    is_complete: bool

    def text(self) -> str:
        """Return the outcome as it is written next to the scene.

        >>> EpisodeOutcome(-12.0, 50, True, True).text()
        'success, return -12, 50 steps'
        """
        if not self.is_complete:
            return "part of an episode"
        word = {None: "", True: "success, ", False: "no success, "}[self.success]
        return f"{word}return {number_text(self.total_reward)}, {self.n_steps} steps"


@dataclass
class Clip:
    """A sequence of scenes, usually one episode."""

    info: ClipInfo
    records: list[Record] = field(default_factory=list)

    def curves(self, panel: str) -> dict[str, list[float | None]]:
        """Return the curves of a panel by label, one entry per scene; None is a gap.

        A metric with one number has the label ``""``, one with several has one per name.
        """
        curves = {curve for record in self.records for curve in record.values}
        return {
            label_of(curve): [record.values.get(curve) for record in self.records]
            for curve in sorted(curves, key=lambda curve: _natural(curve.label))
            if curve.panel == panel
        }

    def range(self, panel: str) -> tuple[float, float]:
        """Return the range of a panel's axis, the same for all its scenes."""
        return _RANGES.get(panel) or value_range(list(self.curves(panel).values()))

    @property
    def shown_rate(self) -> float:
        """Frames per second at which it is shown: real time, or slower if it is short.

        50 steps of a robot take two seconds, in which nobody sees what happens.
        """
        wanted = (len(self.records) - 1) / _SHOWN_SECONDS
        return min(self.info.fps, max(_SLOWEST, wanted))

    def outcomes(self) -> dict[int, EpisodeOutcome]:
        """Return how each episode went, by its number."""
        return _outcomes(
            [record.episode for record in self.records],
            [record.step for record in self.records],
            [record.reward for record in self.records],
            [record.success for record in self.records],
        )


def read_outcomes(path: Path) -> tuple[ClipInfo, dict[int, EpisodeOutcome]]:
    """Return what a clip is about and how its episodes went, without reading its pictures.

    Raises:
        ConfigError: If the file is not a recorded episode.
    """
    with _opened(path) as stored:
        rewards = [None if math.isnan(reward) else reward for reward in stored["reward"].tolist()]
        successes = [None if s == _UNKNOWN else bool(s) for s in stored["success"].tolist()]
        places = stored["episode"].tolist(), stored["step"].tolist()
        return _info(stored), _outcomes(*places, rewards, successes)


def _outcomes(
    episodes: Sequence[int],
    steps: Sequence[int],
    rewards: Sequence[float | None],
    successes: Sequence[bool | None],
) -> dict[int, EpisodeOutcome]:
    outcomes = {}
    for episode in dict.fromkeys(episodes):
        places = [place for place, number in enumerate(episodes) if number == episode]
        known = [rewards[place] for place in places if rewards[place] is not None]
        last = [successes[place] for place in places if rewards[place] is not None]
        outcomes[episode] = EpisodeOutcome(
            math.fsum(reward for reward in known if reward is not None),
            len(known),
            last[-1] if last else None,
            steps[places[0]] == 0 and rewards[places[-1]] is None,
        )
    return outcomes


def label_of(curve: Curve) -> str:
    """Return what the legend says of a curve; numbers of critics are counted from 1.

    >>> label_of(Curve("q_values", "0")), label_of(Curve("q_values", "best 1"))
    ('critic 1', 'best critic 2')
    """
    word = _WORDS.get(curve.panel, "")
    return (
        re.sub(r"\d+$", lambda n: f"{word} {int(n[0]) + 1}", curve.label) if word else curve.label
    )


def title_of(panel: str) -> str:
    """Return what is written above a panel: its metric, with the unit where it has one.

    >>> title_of("entropy"), title_of("reward")
    ('entropy (nats)', 'reward')
    """
    return f"{panel} ({_UNITS[panel]})" if panel in _UNITS else panel


def encode_picture(frame: np.ndarray, *, lossless: bool = False) -> bytes:
    """Compress a frame: JPEG, or PNG if it is small or must be ``lossless``.

    Shapes: ``(height, width, 3)``, uint8.
    """
    from PIL import Image

    image, file = Image.fromarray(frame), io.BytesIO()
    if lossless or max(frame.shape[:2]) <= _SMALL_SIDE:
        image.save(file, "PNG", compress_level=1)
    else:
        image.save(file, "JPEG", quality=_JPEG_QUALITY)
    return file.getvalue()


def decode_picture(picture: bytes) -> np.ndarray:
    """Return the frame of a picture. Shapes: ``(height, width, 3)``, uint8."""
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return np.asarray(image.convert("RGB"))


def picture_size(picture: bytes) -> tuple[int, int]:
    """Return width and height of a picture in pixels, without decoding it."""
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return image.size


def value_range(curves: Sequence[Sequence[float | None]]) -> tuple[float, float]:
    """Return the range of an axis that holds all values, with some room.

    It does not go beyond 0 where no value does: a variance is never negative. Values that hardly
    change are drawn on an axis from 0, because their differences mean nothing.

    >>> value_range([[None]]), value_range([[-1.0, -1.0]]), value_range([[0.0, 10.0]])
    ((0.0, 1.0), (-1.25, 0.0), (0.0, 10.6))
    """
    numbers = [number for curve in curves for number in curve if number is not None]
    if not numbers:
        return 0.0, 1.0
    low, high = min(numbers), max(numbers)
    largest = max(abs(low), abs(high))
    if not largest:
        return 0.0, 1.0
    if high - low < _FLAT * largest:
        return (0.0, 1.25 * high) if low > 0 else (1.25 * low, 0.0)
    room = 0.06 * (high - low)
    return (max(low - room, 0.0) if low >= 0 else low - room), (
        min(high + room, 0.0) if high <= 0 else high + room
    )


def _natural(label: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", label)]


def save_clip(clip: Clip, path: Path) -> None:
    """Write a clip.

    The file holds, with one row per scene: ``observation`` or ``observation.<key>``, ``action`` and
    ``reward`` (NaN in the last scene of an episode), ``terminated``, ``truncated``, ``success``
    (-1: unknown), ``episode``, ``step``, ``total_steps``, ``state`` (MuJoCo's integration state),
    ``values`` (one column per curve, NaN: gap), ``picture`` with ``picture_ends``; and ``about``
    as JSON, which names the curves.
    """
    arrays: dict[str, Any] = _arrays(clip)
    files.atomic_write(path, lambda file: np.savez_compressed(file, **arrays))


def load_clip(path: Path) -> Clip:
    """Read a clip.

    Raises:
        ConfigError: If the file is not a recorded episode.
    """
    with _opened(path) as stored:
        return _clip({name: stored[name] for name in stored.files})


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            yield stored
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"'{path}' is not a recorded episode: {error}") from error


def _arrays(clip: Clip) -> dict[str, np.ndarray]:
    records = clip.records
    curves = list(dict.fromkeys(curve for record in records for curve in record.values))
    about = {
        "format": _FORMAT,
        "info": dataclasses.asdict(clip.info),
        "curves": curves,
        "phases": [record.phase for record in records],
        "events": [record.events for record in records],
        "starts": [record.start for record in records],
        "action_type": _known_action(records).dtype.str,
    }
    arrays = {
        "about": np.array(json.dumps(about)),
        "values": np.array([[r.values.get(curve, np.nan) for curve in curves] for r in records]),
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
    return arrays


def _actions(records: list[Record]) -> np.ndarray:
    gap = np.full(_known_action(records).shape, np.nan)
    return np.array([gap if record.action is None else record.action for record in records])


def _known_action(records: list[Record]) -> np.ndarray:
    return next(record.action for record in records if record.action is not None)


def _clip(arrays: dict[str, np.ndarray]) -> Clip:
    about = json.loads(str(arrays["about"]))
    clip = Clip(_info(arrays))
    # Repeating an episode to the last bit takes the actions in their own type.
    action_type = np.dtype(about.get("action_type", arrays["action"].dtype.str))
    data = arrays["picture"].tobytes()
    for index, end in enumerate(arrays["picture_ends"]):
        start = int(arrays["picture_ends"][index - 1]) if index else 0
        record = _record(arrays, index, data[start : int(end)])
        record.phase, record.events = about["phases"][index], about["events"][index]
        record.start = about.get("starts", {index: ""})[index]
        if record.action is not None:
            record.action = record.action.astype(action_type)
        numbers = zip(about["curves"], arrays["values"][index].tolist(), strict=True)
        record.values = {Curve(*curve): n for curve, n in numbers if not math.isnan(n)}
        clip.records.append(record)
    return clip


def _info(arrays: Mapping[str, np.ndarray]) -> ClipInfo:
    about = json.loads(str(arrays["about"]))
    if about["format"] != _FORMAT:
        raise ValueError(f"its format is {about['format']}, and this version reads {_FORMAT}")
    info = about["info"]
    return ClipInfo(**info | {"panels": tuple(info["panels"])})


def _record(arrays: dict[str, np.ndarray], index: int, picture: bytes) -> Record:
    reward, success = float(arrays["reward"][index]), int(arrays["success"][index])
    is_last_scene = bool(np.isnan(reward))
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
        **numbers,
    )


def _observation(arrays: dict[str, np.ndarray], index: int) -> Observation:
    if "observation" in arrays:
        return arrays["observation"][index]
    return {
        name.removeprefix("observation."): array[index]
        for name, array in arrays.items()
        if name.startswith("observation.")
    }
