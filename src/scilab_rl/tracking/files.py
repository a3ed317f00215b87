"""The run's own files: the authoritative record, written before any other tracker."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from scilab_rl import files
from scilab_rl.errors import ScilabRLError
from scilab_rl.results import RunResult
from scilab_rl.tracking.base import TrackedRun, Tracker

CSV, JSONL = "metrics.csv", "metrics.jsonl"


class FilesTracker(Tracker):
    """Writes ``metrics.csv``, a row per epoch, and ``metrics.jsonl``, a line per epoch or episode.

    In ``metrics.csv`` the columns ``time/...`` come last: all others repeat exactly under a seed.
    """

    def __init__(self) -> None:
        self._rows: list[dict[str, float]] = []
        self._columns: list[str] = []
        self._jsonl: IO[str] | None = None
        self._run_dir = Path()

    def begin(self, run: TrackedRun) -> None:
        """Open the files for appending."""
        self._run_dir = run.run_dir
        if run.resumed_step is not None:
            self._go_back_to(run.resumed_step)
        self._jsonl = (run.run_dir / JSONL).open("a", encoding="utf-8", buffering=1)

    def episode(self, episode: Mapping[str, float]) -> None:
        """Append a line about a training episode."""
        self._write_line({"kind": "episode", **episode})

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Append a row to both files."""
        row = {"epoch": epoch, "step": step, **values}
        self._write_line({"kind": "epoch", **row})
        self._rows.append(row)
        with self._errors_named(CSV):
            self._append_csv(row)
            files.fault_point("metrics.after_row")

    def end(self, result: RunResult) -> None:
        """Close the files."""
        if self._jsonl is not None:
            with contextlib.suppress(OSError):  # a full disk has already been reported
                self._jsonl.close()

    def _go_back_to(self, step: int) -> None:
        """Drop what was written after a checkpoint: it will be measured again."""
        path = self._run_dir / JSONL
        lines = [line for line in files.read_json_lines(path) if line["step"] <= step]
        files.write_text(path, "".join(json.dumps(line) + "\n" for line in lines))
        self._rows = [
            {key: value for key, value in line.items() if key != "kind"}
            for line in lines
            if line["kind"] == "epoch"
        ]
        self._columns = _ordered_columns([name for row in self._rows for name in row])
        if self._rows:
            files.write_text(self._run_dir / CSV, self._format(self._rows, header=True))
        else:
            (self._run_dir / CSV).unlink(missing_ok=True)

    def _write_line(self, line: Mapping[str, object]) -> None:
        assert self._jsonl is not None
        with self._errors_named(JSONL):
            files.fault_point("metrics.before_line")
            self._jsonl.write(json.dumps(line) + "\n")
            files.fault_point("metrics.after_line")

    def _append_csv(self, row: Mapping[str, float]) -> None:
        path = self._run_dir / CSV
        if set(row) <= set(self._columns):
            with path.open("a", encoding="utf-8", newline="") as file:
                file.write(self._format([row], header=False))
            return
        self._columns = _ordered_columns([*self._columns, *row])
        files.write_text(path, self._format(self._rows, header=True))

    def _format(self, rows: Sequence[Mapping[str, object]], *, header: bool) -> str:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns, restval="", lineterminator="\n")
        if header:
            writer.writeheader()
        writer.writerows(rows)
        return text.getvalue()

    @contextlib.contextmanager
    def _errors_named(self, name: str) -> Iterator[None]:
        """Say which file could not be written and how much space is left."""
        path = self._run_dir / name
        try:
            yield
        except OSError as error:
            raise ScilabRLError(
                f"'{path}' cannot be written: {error.strerror} ({_free_space(path)} free)."
            ) from error


def _free_space(path: Path) -> str:
    try:
        return f"{shutil.disk_usage(path.parent).free / 2**20:.0f} MiB"
    except OSError:
        return "unknown space"


def _ordered_columns(names: list[str]) -> list[str]:
    unique = dict.fromkeys(names)
    first = [name for name in ("epoch", "step") if name in unique]
    timed = sorted(name for name in unique if name.startswith("time/"))
    others = sorted(name for name in unique if name not in first and name not in timed)
    return first + others + timed
