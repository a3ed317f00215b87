"""``scilab-rl runs``: the recorded runs, the oldest first."""

from __future__ import annotations

import argparse
import datetime as dt
import itertools
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import Row, is_terminal, print_json, print_rows
from scilab_rl.run.directory import RunDirectory, all_runs
from scilab_rl.run.facts import STATUSES, matches_name, read_run
from scilab_rl.run.provenance import fingerprint_differences
from scilab_rl.search.folders import study_names

_log = logging.getLogger(__name__)

_COLUMNS = (
    "id", "started", "env", "algorithm", "intrinsic", "changed", "seed", "status", "success",
    "reward", "epochs", "steps", "time", "note", "tags", "problem",
)  # fmt: skip
_OPTIONAL = (
    "steps", "started", "time", "epochs", "problem", "reward", "tags", "seed", "note",
)  # fmt: skip
_IF_ANY = ("intrinsic", "changed", "note", "tags", "problem")
_MOST_CHANGED = 3  # keys that a terminal shows
_PROSE = ("changed", "note", "tags")
STUDY = "study"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    studies = study_names(options.base_logdir)
    matching = (
        record
        for run in reversed(list(all_runs(options.base_logdir)))
        if _matches_options(record := read_run(run, studies), options)
    )
    records = list(matching if studies else itertools.islice(matching, options.last))[::-1]
    folds = not (options.json or options.unfold or options.study)
    rows = (list(fold_studies(records)) if folds else records)[-(options.last or 0) :]
    for line in fingerprint_differences(RunDirectory(Path(str(r["path"]))) for r in records):
        _log.warning(line)
    if options.json:
        print_json(rows)
    elif rows:
        shown = [{**row, "time": as_clock(row.get("seconds"))} for row in rows]
        if is_terminal():
            shown = [row | {"changed": _brief(row["changed"])} for row in shown]
        columns = _COLUMNS if is_terminal() else ("run", *_COLUMNS)
        print_rows(columns, shown, optional=_OPTIONAL, if_any=_IF_ANY, prose=_PROSE)
    else:
        _log.info(
            "No such runs in %s, the folder of the place where you are. Each training creates one.",
            options.base_logdir.absolute(),
        )
    return 0


def fold_studies(records: Iterable[Row]) -> Iterator[Row]:
    """Yield the runs, and for each study one row with its best run, where its newest one would be.

    Args:
        records: Facts about runs, the oldest first.
    """
    rows = list(records)
    newest = {row[STUDY]: row for row in rows if row[STUDY] is not None}
    for row in rows:
        name = row[STUDY]
        if name is None:
            yield row
        elif row is newest[name]:
            of_study = [one for one in rows if one[STUDY] == name]
            best = max(of_study, key=lambda one: (_number(one["success"]), _number(one["reward"])))
            kept = ("started", "env", "algorithm", "intrinsic", "success", "reward", STUDY)
            yield {
                **{key: best[key] for key in kept},
                "run": name, "id": STUDY, "changed": name, "status": f"{len(of_study)} runs",
            }  # fmt: skip


def as_clock(seconds: object) -> str | None:
    """Return a duration as hours, minutes and seconds.

    >>> as_clock(3723.4)
    '1:02:03'
    """
    return str(dt.timedelta(seconds=int(seconds))) if isinstance(seconds, (int, float)) else None


def _brief(changed: object) -> object:
    """Return the first changed keys, and how many more there are."""
    if not isinstance(changed, list) or len(changed) <= _MOST_CHANGED:
        return changed
    return [*changed[:_MOST_CHANGED], f"+{len(changed) - _MOST_CHANGED}"]


def _number(value: object) -> float:
    return value if isinstance(value, (int, float)) else float("-inf")


def _matches_options(record: Row, options: argparse.Namespace) -> bool:
    tags = record["tags"]
    assert isinstance(tags, list)
    return (
        matches_name(record["env"], options.env)
        and matches_name(record["algorithm"], options.algorithm)
        and options.status in (None, record["status"])
        and options.study in (None, record[STUDY])
        and (options.tag is None or options.tag in tags)
    )


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "runs", "List the recorded runs, the oldest first.", base=True, json=True
    )
    add = parser.add_argument
    add("--env", help="only this environment; * stands for any text")
    add("--algorithm", help="only this algorithm; * stands for any text")
    add("--status", choices=STATUSES, help="only runs of this status")
    add("--tag", help="only runs with this tag")
    add("--study", metavar="NAME", help="only the runs of this study, one per line")
    add("--unfold", action="store_true", help="a line for each run of a study, not for the study")
    add("--last", type=positive, metavar="N", help="only the newest N")
    return parser.parse_args(arguments)
