"""Choices of participants as arrays, from a table with a row per choice."""

from __future__ import annotations

import csv
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.errors import ConfigError, MissingDependencyError, did_you_mean
from scilab_rl.learning.cognitive import Seen

_log = logging.getLogger(__name__)
Row = Mapping[str, Any]
# The columns are those of HSSM (participant_id, response, rt, feedback) and of a ChoiceTask; tables
# of hBayesDM and others use these names for them.
SYNONYMS = {
    "subjID": "participant_id",
    "subject": "participant_id",
    "subj_idx": "participant_id",
    "participant": "participant_id",
    "choice": "response",
    "outcome": "feedback",
    "reward": "feedback",
    "episode": "block",
}
REQUIRED = ("participant_id", "response", "feedback")
_FIRST_PLANET = 1


@dataclass(frozen=True)
class Panel:
    """The choices of all participants; shorter ones are filled up with choices that do not count.

    Attributes:
        participants: Their codes.
        seen: What was seen before each choice.
        responses: What was chosen, from 0.
        counts: 1 for free choices; 0 for forced ones and where a participant has no more.
        n_states: States of the task.
        n_actions: Responses of the task.
        n_stages: Choices per trial.
        env: The task's id, if the table names one; else empty.
        rows: The rows of each participant.

    Shapes:
        seen, responses, counts: ``(n_participants, n_choices)``.
    """

    participants: tuple[str, ...]
    seen: Seen
    responses: np.ndarray
    counts: np.ndarray
    n_states: int
    n_actions: int
    n_stages: int
    env: str
    rows: tuple[tuple[Row, ...], ...]

    @property
    def n_choices(self) -> np.ndarray:
        """Free choices per participant. Shapes: ``(n_participants,)``."""
        return self.counts.sum(axis=1)

    def has(self, name: str) -> bool:
        """Return whether the table has a column."""
        return name in self.rows[0][0]

    def column(self, name: str) -> np.ndarray:
        """Return a column of numbers; NaN where there is none.

        Shapes:
            result: ``(n_participants, n_choices)``.
        """
        table = np.full(self.responses.shape, np.nan)
        for index, rows in enumerate(self.rows):
            table[index, : len(rows)] = [_number(row, name, math.nan, "the table") for row in rows]
        return table


def read_panel(path: Path) -> Panel:
    """Read a table of choices.

    Args:
        path: CSV, TSV, text with tabs, or Parquet.

    Raises:
        ConfigError: If it cannot be read, or lacks a column.
        MissingDependencyError: If Parquet is read without pyarrow.
    """
    if not path.is_file():
        raise ConfigError(f"There is no table '{path}'.")
    if path.suffix == ".parquet":
        rows = _read_parquet(path)
    else:
        with path.open(encoding="utf-8-sig", newline="") as file:
            separator = "\t" if "\t" in file.readline() else ","
            file.seek(0)
            rows = list(csv.DictReader(file, delimiter=separator))
    if not rows:
        raise ConfigError(f"The table '{path}' has no rows.")
    return make_panel(rows, str(path))


def make_panel(rows: Sequence[Row], origin: str = "the table") -> Panel:
    """Return rows, in the order of the choices, as arrays.

    Rows without a response are left out. Feedback below 0 or above 1 is scaled to 0 to 1, because
    the values of the models begin in the middle of that.

    Args:
        rows: With ``participant_id``, ``response`` and ``feedback``, and perhaps ``block``,
            ``trial``, ``stage``, ``state`` and ``forced``.
        origin: What the rows are, for messages.

    Raises:
        ConfigError: If a column is missing or a value is not a number.
    """
    rows = [_renamed(row) for row in rows]
    rows = _from_two_columns(rows) if "level1_choice" in rows[0] else rows
    for name in REQUIRED:
        if name not in rows[0]:
            raise ConfigError(
                f"{origin} has no column '{name}'.{did_you_mean(name, rows[0])} A row per choice "
                f"needs {', '.join(REQUIRED)}; `scilab-rl export RUN --trials` writes them."
            )
    answered = [row for row in rows if str(row["response"]) not in ("", "nan", "None")]
    if len(answered) < len(rows):
        _log.info("%d rows without a response are left out.", len(rows) - len(answered))
    groups: dict[str, list[Row]] = {}
    for row in answered:
        groups.setdefault(str(row["participant_id"]), []).append(row)
    return _as_arrays(groups, origin)


def _renamed(row: Row) -> Row:
    known = {new for old, new in SYNONYMS.items() if new in row}
    return {
        name if SYNONYMS.get(name) in known else SYNONYMS.get(name, name): value
        for name, value in row.items()
    }


def _as_arrays(groups: Mapping[str, Sequence[Row]], origin: str) -> Panel:
    def column(name: str, default: float, kind: type = float) -> np.ndarray:
        length = max(map(len, groups.values()))
        table = np.zeros((len(groups), length))
        for index, rows in enumerate(groups.values()):
            table[index, : len(rows)] = [_number(row, name, default, origin) for row in rows]
        return table.astype(kind)

    responses, states = column("response", 0, int), column("state", 0, int)
    lengths = np.array([len(rows) for rows in groups.values()])
    exists = np.arange(responses.shape[1]) < lengths[:, None]
    responses = np.where(exists, responses - responses[exists].min(), 0)
    if (column("response", 0)[exists] % 1 != 0).any() or responses.max() > 50:
        raise ConfigError(f"Responses in {origin} must be whole numbers, one for each option.")
    feedback = np.where(exists, _scaled(column("feedback", 0.0), exists), 0.0)
    begins = _begins(groups, responses.shape[1])
    seen = Seen(states, _before(responses), _before(feedback), begins)
    forced = column("forced", 0)
    first_rows = next(iter(groups.values()))
    return Panel(
        participants=tuple(groups),
        seen=seen,
        responses=responses,
        counts=(exists & (forced == 0)).astype(float),
        n_states=int(states.max()) + 1,
        n_actions=max(2, int(responses.max()) + 1),
        n_stages=int(column("stage", 0).max()) + 1,
        env=str(first_rows[0].get("env", "")),
        rows=tuple(tuple(rows) for rows in groups.values()),
    )


def _before(table: np.ndarray) -> np.ndarray:
    """Return what was there one choice before."""
    return np.concatenate([np.zeros_like(table[:, :1]), table[:, :-1]], axis=1)


def _begins(groups: Mapping[str, Sequence[Row]], length: int) -> np.ndarray:
    begins = np.zeros((len(groups), length), bool)
    begins[:, 0] = True
    for index, rows in enumerate(groups.values()):
        blocks = [row.get("block") for row in rows]
        for place in range(1, len(rows)):
            begins[index, place] = blocks[place] != blocks[place - 1]
    return begins


def _scaled(feedback: np.ndarray, exists: np.ndarray) -> np.ndarray:
    low, high = feedback[exists].min(), feedback[exists].max()
    if low < 0:
        size = max(-low, high)
        _log.info("Feedback from %g to %g is scaled: 0.5 is neutral.", low, high)
        return 0.5 + 0.5 * feedback / size
    if high > 1:
        size = 100.0 if high <= 100 else high
        _log.info("Feedback from %g to %g is divided by %g.", low, high, size)
        return feedback / size
    return feedback


def _number(row: Row, name: str, default: float, origin: str) -> float:
    value = str(row.get(name, default))
    if value in ("", "None"):
        return default
    try:
        return float({"True": "1", "False": "0"}.get(value, value))
    except ValueError:
        raise ConfigError(f"The column '{name}' of {origin} has '{value}', not a number.") from None


def _from_two_columns(rows: Sequence[Row]) -> list[Row]:
    """Return two rows for each row of a two-step table of hBayesDM, whose aliens count 1 to 4."""
    steps: list[Row] = []
    for row in rows:
        first, second = int(row["level1_choice"]) - 1, int(row["level2_choice"]) - 1
        both = {"participant_id": row["participant_id"], "block": row.get("block", 0)}
        steps.append({**both, "stage": 0, "state": 0, "response": first, "feedback": 0})
        planet = _FIRST_PLANET + second // 2
        paid = {"response": second % 2, "feedback": row["feedback"]}
        steps.append({**both, "stage": 1, "state": planet, **paid})
    return steps


def _read_parquet(path: Path) -> list[Row]:
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise MissingDependencyError("pyarrow", "parquet", "to read Parquet") from error
    return list(parquet.read_table(path).to_pylist())
