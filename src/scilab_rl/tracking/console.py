"""Progress on the terminal: one bar and a final table, or plain lines without a terminal."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from scilab_rl.config.workspace import tuned_option
from scilab_rl.results import RunResult
from scilab_rl.tracking.base import TrackedRun, Tracker

_REFRESH_SECONDS = 0.2
SHOWN = (
    ("eval/success_rate", "success"),
    ("eval/mean_reward", "reward"),
    ("eval/mean_ep_length", "length"),
    ("rollout/success_rate", "training success"),
)


class ConsoleTracker(Tracker):
    """Shows progress on standard error and the result on standard output."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self.live = is_interactive()
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._run: TrackedRun | None = None
        self._next_refresh = 0.0

    def begin(self, run: TrackedRun) -> None:
        """Say what begins and show the bar."""
        self._run, cfg = run, run.cfg
        tuned = " with tuned values" if tuned_option(cfg.values()) else ""
        self._say(
            f"{cfg.algorithm.name} learns {cfg.env}{tuned} (seed {cfg.seed}, up to {cfg.n_epochs} "
            f"{'epoch' if cfg.n_epochs == 1 else 'epochs'}); results: {run.run_dir}"
        )
        if self.live:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:,.0f}/{task.total:,.0f} steps"),
                TextColumn("{task.fields[speed]}"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[result]}"),
                console=self.console,
                transient=True,
            )
            self._task = self._progress.add_task(
                "epoch 1", total=cfg.total_steps, speed="", result=""
            )
            self._progress.start()

    def step(self, step: int) -> None:
        """Move the bar, a few times per second."""
        if self._progress is None or time.monotonic() < self._next_refresh:
            return
        self._next_refresh = time.monotonic() + _REFRESH_SECONDS
        self._progress.update(self._task, completed=step)

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write one line per epoch."""
        shown = [f"{label} {values[name]:.3g}" for name, label in SHOWN if name in values]
        speed = f"{values['time/fps']:.0f} steps/s"
        self._say(f"epoch {epoch:>3}  {step:>8,} steps  {'  '.join(shown)}  {speed}")
        if self._progress is not None:
            success = values.get("eval/success_rate")
            self._progress.update(
                self._task,
                completed=step,
                description=f"epoch {epoch + 1}",
                speed=speed,
                result="" if success is None else f"success {success:.2f}",
            )

    def end(self, result: RunResult) -> None:
        """Remove the bar and write the final table."""
        if self._progress is not None:
            self._progress.stop()
        if result.status != "failed":
            print_table(_result_rows(result, self._run))

    def _say(self, line: str) -> None:
        if self.live:
            self.console.print(line, highlight=False, markup=False)
        else:
            sys.stderr.write(line + "\n")
            sys.stderr.flush()


def is_interactive() -> bool:
    """Return whether a person watches: a terminal that can redraw, and not a CI job."""
    plain = os.environ.get("TERM") == "dumb" or "CI" in os.environ
    return sys.stderr.isatty() and not plain


def print_table(rows: list[tuple[str, str]], title: str | None = None) -> None:
    """Print facts on standard output: a table on a terminal, ``name: value`` lines elsewhere."""
    if not (sys.stdout.isatty() and is_interactive()):
        for name, value in rows:
            sys.stdout.write(f"{name}: {value}\n")
        sys.stdout.flush()
        return
    table = Table(show_header=False, title=title)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    Console().print(table)


def _result_rows(result: RunResult, run: TrackedRun | None) -> list[tuple[str, str]]:
    rows = [("status", result.status.replace("_", " "))]
    if run is not None:
        cfg = run.cfg
        rows += [
            ("algorithm", cfg.algorithm.name),
            ("environment", cfg.env),
            ("seed", str(cfg.seed)),
        ]
    for name, label in SHOWN:
        if name in result.metrics:
            rows.append((label, f"{result.metrics[name]:.3g}"))
    rows += [
        ("epochs", str(result.epochs)),
        ("steps", f"{result.steps:,}"),
        ("time", f"{result.seconds:.0f} s"),
        ("run", result.run_dir),
    ]
    return rows
