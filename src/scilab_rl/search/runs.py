"""The data of a study about each of its training runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from scilab_rl.search.race import Entry

RUNNING, COMPLETE, PRUNED, FAILED, LOST = "running", "complete", "pruned", "failed", "lost"
FINAL_REPEAT = 10_000  # repeats from here on are the re-evaluation of the winner


@dataclass(frozen=True)
class Run:
    """One training run of one configuration with one seed.

    Attributes:
        number: Its number in the study, from 0.
        trial: Number of the Optuna trial, that is of the configuration.
        repeat: Which repeat of the configuration; equal repeats of all configurations share a seed.
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
        place: The same as HOST:PATH, for machines that do not share it.
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
    place: str = ""
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

    def as_json(self) -> dict[str, object]:
        """Return plain data."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Run:
        """Read plain data."""
        lists = {key: tuple(stored[key]) for key in ("scores", "values", "steps")}
        return cls(**{**stored, **lists})


class RunHistory:
    """All runs of a study in the order of their numbers, and what the race needs to know of them.

    Attributes:
        runs: The runs.
        by_trial: The runs of each configuration, without the re-evaluation of the winner.
    """

    def __init__(self, runs: Iterable[Run] = ()) -> None:
        self.runs: list[Run] = []
        self.by_trial: dict[int, dict[int, Run]] = {}
        self._entries: dict[int, Entry] = {}
        self._changed: list[Run] = []
        self.update(runs)

    def update(self, runs: Iterable[Run]) -> None:
        """Take in runs that are new or have changed."""
        for run in sorted(runs, key=lambda run: run.number):
            self._changed.append(run)
            self.runs[run.number : run.number + 1] = [run]
            if not run.is_final:
                self.by_trial.setdefault(run.trial, {})[run.number] = run
                self._entries.pop(run.trial, None)

    @property
    def n_searched(self) -> int:
        """Runs without the re-evaluation of the winner."""
        return sum(map(len, self.by_trial.values()))

    def take_changed(self) -> list[Run]:
        """Return the runs that are new or have changed since the last call."""
        changed, self._changed = self._changed, []
        return changed

    def entries(self, trials: Iterable[int]) -> list[Entry]:
        """Return what the race needs to know about each configuration.

        Args:
            trials: The numbers of all configurations, also of those without runs.
        """
        return [self._entries.get(number) or self._entry(number) for number in sorted(trials)]

    def _entry(self, number: int) -> Entry:
        runs = self.by_trial.get(number, {}).values()
        entry = self._entries[number] = Entry(
            number,
            tuple(run.scores[0] for run in runs if run.state == COMPLETE),
            sum(run.state == RUNNING for run in runs),
            any(run.state in (PRUNED, FAILED) for run in runs),
        )
        return entry
