"""Tasks played by people: a row per choice, stored before the next one, and the way back."""

from __future__ import annotations

import csv
import io
import os
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from scilab_rl import files, pages
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.choices.base import COLUMNS_KEY, ChoiceTask, feedback_text
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.errors import ConfigError, ScilabRLError
from scilab_rl.recording.records import encode_picture
from scilab_rl.run.parts import render_mode
from scilab_rl.seeding import derive_seed
from scilab_rl.training.trajectory_table import numbered, observation_columns

PRACTICE, TRIALS, END = "practice", "trials", "end"
SETTINGS_FILE = "settings.json"
# Codes that could hold a name with a space, or an address, are refused.
CODE = re.compile(r"[A-Za-z0-9_-]{1,32}")
_MEASURED = ("key", "input", "rt_ms", "n_shown")
_INPUTS = ("key", "held", "mouse", "touch", "pen", "click")
_DIGITS = "1234567890"
_LEFT, _UP, _RIGHT, _DOWN = "ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown"
_NAMED = {"left": _LEFT, "up": _UP, "right": _RIGHT, "down": _DOWN}
_BREAK_AFTER = 30  # choices in a block after which people may rest
Row = dict[str, Any]


class OtherWindowError(ScilabRLError):
    """A participant continues in another window."""


class StorageError(ScilabRLError):
    """A choice could not be stored, and was not made."""


@dataclass(frozen=True)
class Option:
    """What a key does.

    Attributes:
        key: As browsers name it, for example ``ArrowLeft``.
        name: For people.
        action: For the environment.
    """

    key: str
    name: str
    action: Any


def episode_seed(run_seed: int, code: str, phase: str, episode: int) -> int:
    """Return the seed of a participant's episode."""
    return derive_seed(run_seed, "human", code, phase, episode)


def options_of(env: RunEnv) -> tuple[Option, ...]:
    """Return what a person can do in each step, a key for each.

    Raises:
        ConfigError: If there are too many actions for keys.
    """
    task, space = env.unwrapped, env.action_space
    if isinstance(space, spaces.Discrete) and space.n <= len(_DIGITS):
        names = [f"action {index + 1}" for index in range(space.n)]
        names = list(getattr(task, "action_names", names))
        arrows = set(names) <= set(_NAMED)
        return tuple(
            Option(_NAMED[name] if arrows else _DIGITS[index], name, int(space.start) + index)
            for index, name in enumerate(names)
        )
    if isinstance(space, spaces.Box) and space.shape in ((1,), (2,)):
        # Names on the keys would be those of the axes, which a camera may turn.
        axes = ((_LEFT, _RIGHT), (_DOWN, _UP))[: space.shape[0]]
        low = np.where(np.isfinite(space.low), space.low, -1.0)
        high = np.where(np.isfinite(space.high), space.high, 1.0)
        return tuple(
            Option(key, key.removeprefix("Arrow").lower(), _along(axis, end[axis], space))
            for axis, keys in enumerate(axes)
            for key, end in zip(keys, (low, high), strict=True)
        )
    raise ConfigError(
        f"env={env.spec.id if env.spec else task} has the actions {space}, and keys can choose "
        "among at most 10, or move along one or two axes: choose Bandit, TwoStep, HiddenGoal, "
        "Reach1DOF, PointMaze, ..."
    )


def _along(axis: int, value: float, space: spaces.Box) -> np.ndarray:
    action = np.zeros(space.shape, space.dtype)
    action[axis] = value
    return action


class Session:
    """One participant's way through a task; the same choices always lead to the same place.

    Args:
        env: An environment of its own.
        origin: Columns that all rows share, with ``participant_id`` and ``run_seed``.
        n_practice: Trials before the blocks that count.
        n_blocks: Episodes that count.
    """

    def __init__(
        self, env: RunEnv, origin: Mapping[str, Any], *, n_practice: int, n_blocks: int
    ) -> None:
        self.env, self.origin = env, origin
        self.options = options_of(env)
        self.n_practice, self.n_blocks = n_practice, n_blocks
        self.phase = PRACTICE if n_practice else TRIALS
        self.number = 0  # choices until now, with those of practice
        self.window = ""
        self.n_shown = 0
        self.last_feedback = ""
        self.pauses = False
        self._n_practiced = 0
        self._begin(0)

    @property
    def task(self) -> ChoiceTask | None:
        """The task, if it is one of choices."""
        task = self.env.unwrapped
        return task if isinstance(task, ChoiceTask) else None

    def _begin(self, episode: int) -> None:
        self.episode, self.step, self.total = episode, 0, 0.0
        origin = self.origin
        seed = episode_seed(
            int(origin["run_seed"]), str(origin["participant_id"]), self.phase, episode
        )
        self.observation = self.env.reset(seed=seed)[0]

    def choose(self, key: str, *, draws: bool) -> tuple[Row, bytes]:
        """Act, and return the row, and the last picture of an episode that has ended by it.

        Args:
            key: Of an option.
            draws: Whether that picture is needed.
        """
        option = next(option for option in self.options if option.key == key)
        before = 0 if self.task is None else self.task.trial
        observation, reward, terminated, truncated, info = self.env.step(option.action)
        columns = info.get(COLUMNS_KEY, {})
        self.total += float(reward)
        row = {
            **self.origin,
            "episode": self.episode,
            "step": self.step,
            **observation_columns(self.observation),
            **numbered("action", np.asarray(option.action)),
            "reward": float(reward),
            "return_so_far": self.total,
            "terminated": terminated,
            "truncated": truncated,
            **({"success": bool(info["is_success"])} if "is_success" in info else {}),
            **columns,
        }
        self.observation = observation
        self.step += 1
        self.number += 1
        self.n_shown = 0
        self.last_feedback = _feedback_of(columns)
        over = terminated or truncated
        self._n_practiced += int(over) if self.task is None else self.task.trial - before
        practiced = self.phase == PRACTICE and self._n_practiced >= self.n_practice
        self.pauses = practiced or (over and self.task is not None and self.step >= _BREAK_AFTER)
        if not over and not practiced:
            return row, b""
        picture = self.picture() if draws else b""
        self._continue(practiced)
        return row, picture

    def _continue(self, practiced: bool) -> None:
        if practiced:
            self.phase = TRIALS
            self._begin(0)
        elif self.phase == TRIALS and self.episode + 1 == self.n_blocks:
            self.phase = END
        else:
            self._begin(self.episode + 1)

    def picture(self) -> bytes:
        """Return what the task looks like now, as PNG.

        Raises:
            ScilabRLError: If it cannot be drawn.
        """
        frame = self.env.draw()
        if isinstance(frame, str):
            raise ScilabRLError(f"The task cannot be drawn: {frame}")
        return encode_picture(frame, lossless=True)

    @property
    def progress(self) -> float:
        """The share of the present phase that is done, from 0 to 1."""
        if self.phase == END:
            return 1.0
        if self.phase == PRACTICE:
            return min(self._n_practiced / self.n_practice, 1.0)
        spec = self.env.spec
        length = spec.max_episode_steps if spec is not None else None
        part = self.step / length if length else 0.0
        if self.task is not None:
            part = self.task.trial / self.task.n_trials
        return (self.episode + min(part, 1.0)) / self.n_blocks

    def situation(self, ended: bytes = b"") -> Row:
        """Return what a page shows: the picture, keys and progress.

        Args:
            ended: The last picture of the episode before this one.
        """
        pictures = [ended] if ended else []
        if self.phase != END:
            pictures.append(self.picture())
            self.n_shown += 1
        forced = None if self.task is None or self.phase == END else self.task.forced
        return {
            "phase": self.phase,
            "number": self.number,
            "window": self.window,
            "pictures": [pages.data_address(picture) for picture in pictures],
            "options": [
                {"key": option.key, "name": option.name, "enabled": forced in (None, index)}
                for index, option in enumerate(self.options)
            ],
            "feedback": self.last_feedback,
            "block": self.episode,
            "n_blocks": self.n_blocks if self.phase != PRACTICE else 1,
            "progress": self.progress,
            "pauses": self.pauses,
        }


def _feedback_of(columns: Mapping[str, Any]) -> str:
    if "feedback" not in columns or "visits" in columns:  # a walk is fed back by the picture
        return ""
    if columns["stage"] == 0 and "common" in columns:  # only the second stage pays
        return ""
    return feedback_text(columns["feedback"])


class TrialTable:
    """A CSV file that grows by a row per choice; each is on the disk when `append` returns.

    Args:
        path: The file; a last line that a crash has left unfinished is removed.
        columns: Of a new file, or those that it must have.

    Raises:
        ConfigError: If another process writes to it, or it has other columns.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path, self.columns = path, tuple(columns)
        header = (",".join(self.columns) + "\n").encode()
        self._file = path.open("ab")
        if not files.lock(self._file, wait=False):
            self._file.close()
            raise ConfigError(f"{path} is in use: its page is being served already.")
        content = path.read_bytes()
        complete = content[: content.rfind(b"\n") + 1]
        if len(complete) < len(content):
            self._file.truncate(len(complete))
        if not complete:
            self._store(header)
        elif not complete.startswith(header):
            self._file.close()
            raise ConfigError(f"{path} has other columns: choose another folder with --output.")
        files.fsync_directory(path.parent)

    def rows_of(self, code: str) -> list[dict[str, str]]:
        """Return the rows of a participant."""
        with self.path.open(encoding="utf-8", newline="") as file:
            return [row for row in csv.DictReader(file) if row["participant_id"] == code]

    def append(self, row: Mapping[str, Any]) -> None:
        """Store a row.

        Raises:
            StorageError: If that fails; the file is as before.
        """
        line = io.StringIO()
        writer = csv.DictWriter(line, self.columns, extrasaction="ignore", lineterminator="\n")
        writer.writerow(dict(row))
        self._store(line.getvalue().encode())

    def _store(self, line: bytes) -> None:
        size = os.fstat(self._file.fileno()).st_size
        try:
            files.fault_point("human.before_row")
            self._file.write(line)
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            self._file.truncate(size)
            raise StorageError(f"The choice could not be stored: {error}.") from error
        files.fault_point("human.after_row")

    def close(self) -> None:
        """Close the file, which unlocks it."""
        self._file.close()


class HumanSessions:
    """The participants of a task, their tables, and the sessions that are open.

    ``trials.csv`` has a row per choice of all participants, ``practice.csv`` the same of practice.

    Args:
        cfg: The environment, its arguments and the seed; each participant has draws of their own.
        folder: Where the tables are, and are continued.
        n_practice: Practice trials.
        n_blocks: Blocks that count.

    Raises:
        ConfigError: If the folder belongs to another task, or people cannot play this one.
    """

    def __init__(self, cfg: RunConfig, folder: Path, *, n_practice: int, n_blocks: int) -> None:
        self.cfg, self.n_practice, self.n_blocks = cfg, n_practice, n_blocks
        self._sessions: dict[str, Session] = {}
        self._mode = render_mode("record")
        self._origin = {
            "run": folder.name, "env": cfg.env, "algorithm": "human", "run_seed": cfg.seed,
        }  # fmt: skip
        probe = self._make("probe")
        self.title = getattr(probe.task, "title", "") or cfg.env.rpartition("-v")[0]
        self.is_choice_task, self.family = probe.task is not None, family_of(probe.env)
        row, _ = probe.choose(probe.options[0].key, draws=True)
        probe.picture()  # an error before anything is written
        probe.env.close()
        folder.mkdir(parents=True, exist_ok=True)
        _check_settings(folder / SETTINGS_FILE, cfg, n_practice, n_blocks)
        columns = [*row, *_MEASURED]
        self.tables: dict[str, TrialTable] = {}
        for phase in (TRIALS, PRACTICE):
            self.tables[phase] = TrialTable(folder / f"{phase}.csv", columns)

    def join(self, code: str) -> Row:
        """Let a participant begin, or continue in a window that replaces all others of theirs.

        Raises:
            ConfigError: If the code is not allowed.
        """
        if not CODE.fullmatch(code):
            raise ConfigError(
                "A participant code has 1 to 32 letters (a-z), digits, - or _, and no personal "
                "data such as a name or an address."
            )
        session = self._session(code)
        session.window = secrets.token_hex(8)
        return session.situation()

    def choose(self, code: str, window: str, number: int, key: str, how: str, rt_ms: float) -> Row:
        """Make and store a choice.

        Args:
            code: Of the participant.
            window: What `join` has returned.
            number: The choice that is answered, from 0; an earlier one is not made again.
            key: Of an option.
            how: key, held, mouse, touch, pen or click.
            rt_ms: From the stimulus on the screen to the answer, in ms.

        Raises:
            OtherWindowError: If another window has taken over.
            ConfigError: If there is no such choice.
            StorageError: If it cannot be stored.
        """
        session = self._session(code)
        if not window or window != session.window:
            raise OtherWindowError("This session continues in another window.")
        if number < session.number:  # the answer to it was lost
            return session.situation()
        keys = [option.key for option in session.options]
        if number > session.number or key not in keys or how not in _INPUTS or not rt_ms >= 0:
            raise ConfigError("There is no such choice now.")
        if session.phase == END:
            raise ConfigError("The session has ended.")
        phase, n_shown = session.phase, session.n_shown
        row, ended = session.choose(key, draws=True)
        measured = {"key": key, "input": how, "rt_ms": round(rt_ms, 1), "n_shown": n_shown}
        try:
            self.tables[phase].append(row | measured)
        except StorageError:
            self._forget(code)  # it is ahead of the table
            raise
        return session.situation(ended)

    def close(self) -> None:
        """Close tables and environments."""
        for code in list(self._sessions):
            self._forget(code)
        for table in self.tables.values():
            table.close()

    def _make(self, code: str) -> Session:
        env = make_single_env(self.cfg, self._mode)
        origin = self._origin | {"participant_id": code}
        return Session(env, origin, n_practice=self.n_practice, n_blocks=self.n_blocks)

    def _session(self, code: str) -> Session:
        """Return the session of a participant, replayed from the tables if it is not open."""
        if code not in self._sessions:
            session = self._make(code)
            rows = [*self.tables[PRACTICE].rows_of(code), *self.tables[TRIALS].rows_of(code)]
            for recorded in rows:
                row, _ = session.choose(recorded["key"], draws=False)
                if str(row["reward"]) != recorded["reward"]:
                    raise ScilabRLError(
                        f"The task no longer does what it did for {code}, choice {session.number}: "
                        f"the reward was {recorded['reward']}, and is {row['reward']}."
                    )
            session.last_feedback, session.pauses = "", False
            self._sessions[code] = session
        return self._sessions[code]

    def _forget(self, code: str) -> None:
        # Its window stays: the choice is made again by the same page.
        window = self._sessions[code].window
        self._sessions.pop(code).env.close()
        if not self.tables[TRIALS]._file.closed:
            self._session(code).window = window


def family_of(env: RunEnv) -> str:
    """Return the name of the shipped instructions that fit a task."""
    name = type(env.unwrapped).__name__
    families = {"Bandit": "bandit", "ProbabilisticReversal": "bandit", "TwoStep": "two_step",
                "Horizon": "horizon", "HiddenGoal": "hidden_goal"}  # fmt: skip
    return families.get(name, "movement")


def _check_settings(path: Path, cfg: RunConfig, n_practice: int, n_blocks: int) -> None:
    import json

    settings = {
        "env": cfg.env, "env_kwargs": dict(cfg.env_kwargs), "seed": cfg.seed,
        "practice": n_practice, "blocks": n_blocks,
    }  # fmt: skip
    if not path.exists():
        files.write_json(path, settings)
        return
    stored = json.loads(path.read_text(encoding="utf-8"))
    for key, value in settings.items():
        if stored.get(key) != value:
            raise ConfigError(
                f"{path.parent} was begun with {key}={stored.get(key)}, not {value}: continue it "
                "with the same settings, or choose another folder with --output."
            )
