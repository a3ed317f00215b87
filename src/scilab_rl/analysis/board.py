"""The board: all runs and studies on one page that needs no server and no network.

Curves are stored with 16 bits per value between the smallest and the largest one of the curve, and
thinned until the page is small enough to open at once; tables have the exact last values.
"""

from __future__ import annotations

import base64
import datetime as dt
import hashlib
import json
import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl import files
from scilab_rl.config.schema import learning_config
from scilab_rl.errors import ConfigError
from scilab_rl.pages import render
from scilab_rl.recording.records import FOLDER as EPISODES
from scilab_rl.run.annotations import ANNOTATIONS_FILE
from scilab_rl.run.curves import CURVE_FILE
from scilab_rl.run.directory import CONFIG_FILE, RESULT_FILE, RunDirectory, all_runs, read_epochs
from scilab_rl.run.facts import read_run
from scilab_rl.search.folders import REPORT, STUDIES, study_names

BOARD_FILE = "board.html"
_MOST_POINTS, _FEWEST_POINTS = 200, 20  # of a curve
_MOST_VALUES = 3_500_000  # of all curves together: 10 MB
_MISSING = 2**16 - 1
_N_PAGES = 6  # of one run that are linked, the newest ones
_PAGE_FOLDERS = ("goals", "whatif")  # of pages that commands make of a run
_OVERVIEWS = ("episodes", "highlights")
# What the page shows of `read_run`.
_FACTS = (
    "run", "id", "started", "seed", "status", "success", "reward", "epochs", "steps", "seconds",
    "note", "tags", "problem",
)  # fmt: skip
_IN_NAME = (
    "env", "algorithm.name", "algorithm._target_", "algorithm.intrinsic",
    "algorithm.intrinsic.name",
)  # fmt: skip


@dataclass(frozen=True)
class BoardRun:
    """One run as the board shows it.

    Attributes:
        facts: As `read_run` returns them.
        config: The part of the configuration that affects learning.
        rows: Its evaluations.
        links: Name and address, relative to the folder of all runs.
    """

    facts: Mapping[str, Any]
    config: Mapping[str, str]
    rows: Sequence[Mapping[str, Any]]
    links: Sequence[tuple[str, str]]


class BoardReader:
    """Reads the runs of a folder, again only those that have changed since the last time.

    Args:
        base: The folder of all runs.
    """

    def __init__(self, base: Path) -> None:
        self.base = base
        self._known: dict[Path, tuple[object, BoardRun]] = {}

    def read(self) -> dict[str, object]:
        """Return what the page shows, as JSON has it."""
        studies = study_names(self.base)
        runs = [self._read_run(run, studies) for run in all_runs(self.base)]
        groups = _grouped(runs)
        return {
            "written": f"{dt.datetime.now():%Y-%m-%d %H:%M}",
            "base": self.base.resolve().name,
            "root": "",
            "groups": groups,
            "runs": _columns(runs),
            "studies": [_study(name, self.base) for name in studies],
            **_curves([run.rows for run in runs]),
        }

    def version(self) -> str:
        """Return a text that changes whenever a run does."""
        states = [(str(run.path), self._state(run)) for run in all_runs(self.base)]
        return hashlib.sha256(repr(states).encode()).hexdigest()[:16]

    def _read_run(self, run: RunDirectory, studies: Sequence[str]) -> BoardRun:
        state = self._state(run)
        if run.path not in self._known or self._known[run.path][0] != state:
            self._known[run.path] = state, _read(run, studies, self.base)
        return self._known[run.path][1]

    def _state(self, run: RunDirectory) -> object:
        """Return what changes with a run: its files, and whether one that trains still does."""
        known = self._known.get(run.path)
        trains = known is not None and known[1].facts["status"] == "running"
        return _state(run), trains and run.is_in_use()


def write_board(base: Path, path: Path | None = None) -> Path:
    """Write the page.

    Args:
        base: The folder of all runs.
        path: The file; None: ``board.html`` in that folder.

    Returns:
        The file.
    """
    path = path or base / BOARD_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    root = Path(os.path.relpath(base, path.parent)).as_posix()
    content = {**BoardReader(base).read(), "root": "" if root == "." else f"{root}/"}
    files.write_text(path, render_board(content, watches=False))
    return path


def render_board(content: Mapping[str, object], *, watches: bool) -> str:
    """Return the page.

    Args:
        content: Of `BoardReader.read`.
        watches: Whether the page asks its server for news.
    """
    return render("board.html", title="Runs", board=content, watches=watches)


def _state(run: RunDirectory) -> object:
    """Return what changes whenever anything that the board shows of a run changes."""
    files_shown = (CONFIG_FILE, RESULT_FILE, "metrics.jsonl", ANNOTATIONS_FILE)
    found = []
    for name in (*files_shown, EPISODES, *_PAGE_FOLDERS):
        try:
            status = (run / name).stat()
            found.append((name, status.st_mtime_ns, status.st_size))
        except OSError:
            found.append((name, 0, 0))
    return found, run.path.stat().st_mtime_ns


def _read(run: RunDirectory, studies: Sequence[str], base: Path) -> BoardRun:
    try:
        config = learning_config(run.read_config())
    except (ConfigError, AttributeError, TypeError):
        config = {}
    try:
        rows = read_epochs(run)
    except (OSError, ValueError):  # not the text that a run writes
        rows = []
    return BoardRun(read_run(run, studies), config, rows, list(_links(run, base)))


def _links(run: RunDirectory, base: Path) -> Iterable[tuple[str, str]]:
    """Yield what a browser can show of a run: pages, the newest replays, curve and files."""
    address = run.path.relative_to(base).as_posix()
    pages = [page for folder in _PAGE_FOLDERS for page in sorted(run.path.glob(f"{folder}/*.html"))]
    found = sorted(run.path.glob(f"{EPISODES}/*.html"), reverse=True)
    overviews = [path for path in found if path.stem in _OVERVIEWS]
    replays = [path for path in found if path.stem not in _OVERVIEWS][: _N_PAGES - len(overviews)]
    for path in (*pages, *overviews, *replays):
        kind = "replay" if path in replays else path.parent.name
        is_named = path in overviews or path.stem == kind
        name = path.stem if is_named else f"{kind} {path.stem}"
        yield name, f"{address}/{path.parent.name}/{path.name}"
    if (run / CURVE_FILE).is_file():
        yield "curve", f"{address}/{CURVE_FILE}"
    yield "files", f"{address}/"


def _grouped(runs: Sequence[BoardRun]) -> list[dict[str, object]]:
    """Return the runs by configuration, with what is not as in most of them."""
    by_config: dict[str, list[int]] = defaultdict(list)
    for index, run in enumerate(runs):
        facts = run.facts
        described = [facts["env"], facts["algorithm"], facts["study"], dict(run.config)]
        by_config[json.dumps(described, sort_keys=True)].append(index)
    siblings: dict[tuple[object, object], list[Mapping[str, str]]] = defaultdict(list)
    for members in by_config.values():
        first = runs[members[0]]
        siblings[first.facts["env"], first.facts["algorithm"]].append(first.config)
    groups = []
    for key, members in by_config.items():
        first = runs[members[0]]
        alike = siblings[first.facts["env"], first.facts["algorithm"]]
        groups.append(
            {
                "key": hashlib.sha256(key.encode()).hexdigest()[:6],
                **{name: first.facts[name] for name in ("env", "algorithm", "intrinsic", "study")},
                "label": differing_keys(first.config, alike),
                "config": first.config,
                "runs": members,
            }
        )
    return groups


def differing_keys(config: Mapping[str, str], alike: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the keys of a configuration that are not as in most others, with its values.

    >>> differing_keys({"algorithm.b": "2"}, [{"algorithm.b": "3"}, {"algorithm.b": "3", "a": "1"}])
    ['b=2']
    """
    labels = []
    for key in sorted({key for one in alike for key in one} - set(_IN_NAME)):
        (usual, _), *_ = Counter(one.get(key) for one in alike).most_common(1)
        if config.get(key) != usual:
            value = config.get(key, "-")
            labels.append(f"{key.removeprefix('algorithm.')}={value.strip(chr(34))}")
    return labels


def _columns(runs: Sequence[BoardRun]) -> dict[str, list[object]]:
    columns: dict[str, list[object]] = {
        name: [_plain(run.facts[name]) for run in runs] for name in _FACTS
    }
    return {**columns, "links": [run.links for run in runs]}


def _plain(value: object) -> object:
    """Return a value that JSON has; there is no NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _study(name: str, base: Path) -> dict[str, object]:
    report = base / STUDIES / name / REPORT
    return {"name": name, "report": f"{STUDIES}/{name}/{REPORT}" if report.is_file() else None}


def _curves(runs: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, object]:
    """Return the steps of each run, and each metric as blocks of 16-bit numbers."""
    names = sorted({name for rows in runs for row in rows for name in row if "/" in name})
    n_values = sum(len(rows) for rows in runs) * len(names)
    n_points = _MOST_POINTS
    if n_values > _MOST_VALUES:
        n_points = max(_MOST_VALUES // max(len(runs) * len(names), 1), _FEWEST_POINTS)
    thinned = [_thinned(rows, n_points) for rows in runs]
    return {
        "steps": [[row["step"] for row in rows] for rows in thinned],
        "metrics": {name: _encoded(thinned, name) for name in names},
        "thinned": max((len(rows) for rows in runs), default=0) > n_points,
    }


def _thinned(rows: Sequence[Mapping[str, Any]], n_points: int) -> list[Mapping[str, Any]]:
    """Return at most so many rows at equal distances; the last one is always among them."""
    whole = [row for row in rows if isinstance(row.get("step"), (int, float))]
    if len(whole) <= n_points:
        return whole
    return [whole[int(place)] for place in np.linspace(0, len(whole) - 1, n_points).round()]


def _encoded(runs: Sequence[Sequence[Mapping[str, Any]]], name: str) -> dict[str, object]:
    """Return the values of a metric: ranges per run, and all of them one after the other."""
    blocks, ranges, present = [], [], []
    for index, rows in enumerate(runs):
        values = np.array([_number(row.get(name)) for row in rows])
        if not np.isfinite(values).any():
            continue
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        share = (values - low) / (high - low) if high > low else values * 0.0
        is_missing = np.isnan(share)
        numbers = np.where(is_missing, 0.0, share * (_MISSING - 1)).round()
        blocks.append(np.where(is_missing, _MISSING, numbers).astype("<u2"))
        ranges.append((float(f"{low:.7g}"), float(f"{high:.7g}")))
        present.append(index)
    data = np.concatenate(blocks).tobytes() if blocks else b""
    return {"runs": present, "ranges": ranges, "data": base64.b64encode(data).decode()}


def _number(value: object) -> float:
    is_finite = isinstance(value, (int, float)) and math.isfinite(value)
    return float(value) if is_finite else math.nan  # type: ignore[arg-type]
