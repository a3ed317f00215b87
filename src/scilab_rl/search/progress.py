"""Progress of a study on the terminal: what runs, what is best so far, how long it takes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from scilab_rl.parallel.progress import Progress, time_left
from scilab_rl.search import race
from scilab_rl.search.runs import COMPLETE, FAILED, LOST, PRUNED, RUNNING, Run, RunHistory
from scilab_rl.search.settings import StudySettings
from scilab_rl.search.summary import with_interval

_MARKS = {COMPLETE: "done", PRUNED: "pruned", FAILED: "FAILED", LOST: "lost, will be repeated"}


class StudyProgress:
    """Writes a line for each run that ends, and on a terminal the state of the study below.

    Args:
        directory: The folder of the study.
        settings: The settings of the study.
        n_workers: Runs at the same time.
    """

    def __init__(self, directory: Path, settings: StudySettings, n_workers: int) -> None:
        self.directory = directory
        self.settings = settings
        self.n_workers = n_workers
        self._progress = Progress()
        self._reported: dict[int, str] = {}
        self._n_before: int | None = None

    def __enter__(self) -> StudyProgress:
        self._progress.say(
            f"{self.directory.name}: {self.settings.max_trials} runs, {self.n_workers} at a time; "
            "to end it after the running ones: Ctrl-C, or from elsewhere "
            f"scilab-rl study stop {self.directory.name}"
        )
        self._progress.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._progress.__exit__(kind, error, _)

    def update(self, runs: Sequence[Run]) -> None:
        """Tell what has changed."""
        if self._n_before is None:
            self._n_before = sum(run.state in _MARKS and not run.is_final for run in runs)
        for run in runs:
            if self._reported.get(run.number) != run.state and run.state in _MARKS:
                self._progress.say(_line(run))
            self._reported[run.number] = run.state
        self._progress.show(self._state(runs))

    def _state(self, runs: Sequence[Run]) -> list[str]:
        searched = [run for run in runs if not run.is_final]  # what max_trials counts
        ended = sum(run.state in _MARKS and run.state != LOST for run in searched)
        lines = [f"{ended} of {self.settings.max_trials} runs, {self._time_left(searched)}"]
        best = self._best(runs)
        if best:
            lines.append(f"best so far: {best}")
        for run in runs:
            if run.state == RUNNING:
                minutes = (time.time() - run.started) / 60
                lines.append(f"  run {run.number}: configuration #{run.trial}, {minutes:.1f} min")
        return lines

    def _time_left(self, runs: Sequence[Run]) -> str:
        here = sum(run.state in _MARKS for run in runs) - (self._n_before or 0)
        left = self.settings.max_trials - sum(run.state in _MARKS for run in runs)
        return time_left(self._progress.seconds, here, left)

    def _best(self, runs: Sequence[Run]) -> str:
        rules = self.settings.rules
        entries = RunHistory(runs).entries({run.trial for run in runs})
        best = race.winner(entries, rules) if rules.racing else None
        if best is None:
            return ""
        spread = race.spread_of([entry for entry in entries if entry.scores], rules)
        interval = with_interval(best.mean, race.half_width(best, spread))
        return f"configuration #{best.number} with {interval} ({len(best.scores)} runs)"


def _line(run: Run) -> str:
    what = "winner, new seed" if run.is_final else f"repeat {run.repeat + 1}"
    scores = "  score " + ", ".join(f"{score:.4g}" for score in run.scores) if run.scores else ""
    error = f"  {run.error}" if run.error else ""
    return (
        f"run {run.number:>3}  configuration #{run.trial} ({what})  "
        f"{_MARKS[run.state]} after {run.seconds:.0f} s{scores}{error}"
    )
