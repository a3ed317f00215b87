"""What a study knows about each of its training runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from scilab_rl.hyperopt.race import Entry

RUNNING, COMPLETE, PRUNED, FAILED, LOST = "running", "complete", "pruned", "failed", "lost"
FINAL_REPEAT = 10_000  # repeats from here on are the re-evaluation of the winner


@dataclass(frozen=True)
class Run:
    """One training run of one setting with one seed.

    Attributes:
        number: Its number in the study, from 0.
        trial: Number of the Optuna trial, that is of the setting.
        repeat: Which repeat of the setting; equal repeats of all settings share a seed.
        seed: Seed of the run.
        state: ``running``, ``complete``, ``pruned``, ``failed``, or ``lost``: the machine ended it,
            and it will be repeated.
        owner: The process that watches it.
        started: Unix time, in seconds.
        scores: One number per objective, when complete.
        values: The criterion at each evaluation.
        steps: Environment steps at each evaluation.
        seconds: Wall time.
        run_dir: Its directory, once it has one.
        error: One line that says why it failed or was lost.
        attempt: How often the machine has ended this repeat before.
    """

    number: int
    trial: int
    repeat: int
    seed: int
    state: str
    owner: str
    started: float
    scores: tuple[float, ...] = ()
    values: tuple[float, ...] = ()
    steps: tuple[int, ...] = ()
    seconds: float = 0.0
    run_dir: str = ""
    error: str = ""
    attempt: int = 0

    @property
    def identity(self) -> tuple[int, int]:
        """What tells runs apart, attempts included."""
        return self.number, self.attempt

    @property
    def is_final(self) -> bool:
        """Whether the run re-evaluates the winner."""
        return self.repeat >= FINAL_REPEAT

    def with_(self, **changes: Any) -> Run:
        """Return a copy with some attributes changed."""
        return dataclasses.replace(self, **changes)

    def as_json(self) -> dict[str, Any]:
        """Return plain data."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Run:
        """Read plain data."""
        lists = {key: tuple(stored[key]) for key in ("scores", "values", "steps")}
        return cls(**{**stored, **lists})


def entries_of(runs: Iterable[Run], trials: Iterable[int]) -> list[Entry]:
    """Return what the race needs to know about each setting.

    Args:
        runs: All runs; those of the final re-evaluation do not count.
        trials: The numbers of all settings, also of those without runs.
    """
    by_trial: dict[int, list[Run]] = {number: [] for number in trials}
    for run in runs:
        if not run.is_final and run.trial in by_trial:
            by_trial[run.trial].append(run)
    return [_entry(number, by_trial[number]) for number in sorted(by_trial)]


def _entry(number: int, runs: list[Run]) -> Entry:
    return Entry(
        number,
        tuple(run.scores[0] for run in runs if run.state == COMPLETE),
        sum(run.state == RUNNING for run in runs),
        any(run.state in (PRUNED, FAILED) for run in runs),
    )
