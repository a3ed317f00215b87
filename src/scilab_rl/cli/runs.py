"""``scilab-rl runs``: the recorded runs, the oldest first."""

from __future__ import annotations

import datetime as dt
import itertools
import logging
import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import print_json, print_rows
from scilab_rl.errors import ConfigError
from scilab_rl.results import PRUNED, SOLVED
from scilab_rl.run.directory import RESULT_FILE, RunDirectory, all_runs, read_epochs
from scilab_rl.run.provenance import fingerprint_differences

_log = logging.getLogger(__name__)

DAMAGED = "damaged"
CRASHED = "crashed"  # recorded as running, but its process is gone
STATUSES = ("running", CRASHED, "finished", SOLVED, PRUNED, "interrupted", "failed", DAMAGED)
_COLUMNS = (
    "run", "env", "algorithm", "seed", "status", "success", "reward", "epochs", "steps", "time",
    "problem",
)  # fmt: skip
# The name of a run contains these.
_OPTIONAL = ("problem", "seed", "algorithm", "env", "epochs", "reward")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "runs", "List the recorded runs, the oldest first.", base=True, json=True
    )
    parser.add_argument("--env", help="only this environment; * stands for any text")
    parser.add_argument("--algorithm", help="only this algorithm; * stands for any text")
    parser.add_argument("--status", choices=STATUSES, help="only runs of this status")
    parser.add_argument("--last", type=positive, metavar="N", help="only the newest N")
    options = parser.parse_args(arguments)

    matching = (
        record
        for record in map(read_run, reversed(list(all_runs(options.base_logdir))))
        if _matches(record["env"], options.env)
        and _matches(record["algorithm"], options.algorithm)
        and options.status in (None, record["status"])
    )
    records = list(itertools.islice(matching, options.last))[::-1]
    for line in fingerprint_differences(RunDirectory(Path(str(r["path"]))) for r in records):
        _log.warning(line)
    if options.json:
        print_json(records)
    elif records:
        rows = [{**record, "time": as_clock(record["seconds"])} for record in records]
        print_rows(_COLUMNS, rows, optional=_OPTIONAL, if_any=("problem",))
    else:
        _log.info("No such runs in '%s'. Each training creates one.", options.base_logdir)
    return 0


def read_run(run: RunDirectory) -> dict[str, object]:
    """Return the facts about a run; damaged files make its status ``damaged``.

    Args:
        run: The directory of the run.

    Returns:
        The run's name, environment, algorithm, seed and status, the last values of success and
        reward, the epochs, steps and seconds of training, its path, and the problem, if any.
    """
    config, problem = {}, None
    try:
        config = run.read_config()
    except ConfigError as error:
        problem = str(error)
    algorithm = config.get("algorithm")
    record: dict[str, object] = {
        "run": run.path.name,
        "env": config.get("env"),
        "algorithm": algorithm.get("name") if isinstance(algorithm, dict) else None,
        "seed": config.get("seed"),
        "status": DAMAGED,
    }
    result = run.read_result()
    if result is None:
        problem = problem or f"{RESULT_FILE} is missing or damaged"
    else:
        problem = problem or result.error
        record["status"] = result.status if config else DAMAGED
        if record["status"] == "running" and not run.is_in_use():
            record["status"] = CRASHED
    values: Mapping[str, object] = result.metrics if result is not None else {}
    if not isinstance(values, dict) or not values:
        values = _last_epoch(run)  # of a run that is still training
    return record | {
        "success": values.get("eval/success_rate"),
        "reward": values.get("eval/mean_reward"),
        "epochs": (result and result.epochs) or values.get("epoch"),
        "steps": (result and result.steps) or values.get("step"),
        "seconds": (result and result.seconds) or None,
        "problem": problem,
        "path": str(run),
    }


def as_clock(seconds: object) -> str | None:
    """Return a duration as hours, minutes and seconds.

    >>> as_clock(3723.4)
    '1:02:03'
    """
    return str(dt.timedelta(seconds=int(seconds))) if isinstance(seconds, (int, float)) else None


def _last_epoch(run: RunDirectory) -> dict[str, object]:
    try:
        return (read_epochs(run) or [{}])[-1]
    except (OSError, ValueError):  # not the text that a run writes
        return {}


def _matches(value: object, pattern: str | None) -> bool:
    """Return whether a name matches a pattern, an id also without its version."""
    if pattern is None:
        return True
    names = (str(value), re.sub(r"-v\d+$", "", str(value)))
    return any(fnmatchcase(name.lower(), pattern.lower()) for name in names)
