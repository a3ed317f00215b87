"""``scilab-rl runs``: the recorded runs, the oldest first."""

from __future__ import annotations

import datetime as dt
import itertools
import logging
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import yaml

from scilab_rl.commands.parser import CommandParser, positive
from scilab_rl.commands.tables import print_json, print_rows
from scilab_rl.provenance import fingerprint_differences
from scilab_rl.results import CONFIG_FILE, RESULT_FILE, RunDirectory, all_runs, read_epochs

_log = logging.getLogger(__name__)

DAMAGED = "damaged"
CRASHED = "crashed"  # says running, but its process is gone
STATUSES = ("running", CRASHED, "finished", "stopped_early", "interrupted", "failed", DAMAGED)
_COLUMNS = (
    "run", "env", "algorithm", "seed", "status", "success", "reward", "epochs", "steps", "time",
    "problem",
)  # fmt: skip
# The name of a run tells these too.
_OPTIONAL = ("problem", "seed", "algorithm", "env", "epochs", "reward")
# The C loader is ten times faster, and there may be thousands of runs.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("runs", "List the recorded runs, the oldest first.")
    parser.add_argument("--env", help="only this environment; * stands for any text")
    parser.add_argument("--algorithm", help="only this algorithm; * stands for any text")
    parser.add_argument("--status", choices=STATUSES, help="only runs of this status")
    parser.add_argument("--last", type=positive, metavar="N", help="only the newest N")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"), help="default: data")
    parser.add_argument("--json", action="store_true", help="print JSON, with times in seconds")
    options = parser.parse_args(arguments)

    fitting = (
        record
        for record in _newest_first(options.base_logdir)
        if _fits(record["env"], options.env)
        and _fits(record["algorithm"], options.algorithm)
        and options.status in (None, record["status"])
    )
    records = list(itertools.islice(fitting, options.last))[::-1]
    for line in fingerprint_differences(RunDirectory(Path(record["path"])) for record in records):
        _log.warning(line)
    if options.json:
        print_json(records)
    elif records:
        rows = [{**record, "time": as_clock(record["seconds"])} for record in records]
        columns = [c for c in _COLUMNS if c != "problem" or any(row["problem"] for row in rows)]
        print_rows(columns, rows, optional=[name for name in _OPTIONAL if name in columns])
    else:
        _log.info("No such runs in '%s'. Every training leaves one there.", options.base_logdir)
    return 0


def read_run(run: RunDirectory) -> dict[str, Any]:
    """Return what is known about a run; damaged files make its status ``damaged``.

    Args:
        run: The directory of the run.

    Returns:
        The run's name, environment, algorithm, seed and status, the last values of success and
        reward, the epochs, steps and seconds of training, its path, and the problem, if any.
    """
    config, problem = _read_config(run)
    algorithm = config.get("algorithm")
    record = {
        "run": run.path.name,
        "env": config.get("env"),
        "algorithm": algorithm.get("name") if isinstance(algorithm, dict) else None,
        "seed": config.get("seed"),
        "status": DAMAGED,
    }
    result = run.read_result()
    if result is None:
        problem = problem or f"{RESULT_FILE} is missing or damaged"
        values, epochs, steps, seconds = _last_epoch(run), None, None, None
    else:
        values, epochs, steps, seconds = result.metrics, result.epochs, result.steps, result.seconds
        problem = problem or result.error
        record["status"] = _status(run, result.status) if config else DAMAGED
    if not isinstance(values, dict) or not values:
        values = _last_epoch(run)  # a run that is still going on
    return record | {
        "success": values.get("eval/success_rate"),
        "reward": values.get("eval/mean_reward"),
        "epochs": epochs or values.get("epoch"),
        "steps": steps or values.get("step"),
        "seconds": seconds or None,
        "problem": problem,
        "path": str(run),
    }


def _status(run: RunDirectory, recorded: str) -> str:
    return CRASHED if recorded == "running" and not run.is_in_use() else recorded


def as_clock(seconds: Any) -> str | None:
    """Return a duration as hours, minutes and seconds.

    >>> as_clock(3723.4)
    '1:02:03'
    """
    return str(dt.timedelta(seconds=int(seconds))) if isinstance(seconds, (int, float)) else None


def _newest_first(base: Path) -> Iterator[dict[str, Any]]:
    for run in reversed(list(all_runs(base))):
        yield read_run(run)


def _read_config(run: RunDirectory) -> tuple[dict[str, Any], str | None]:
    """Return a run's configuration as plain data, or an empty one and what is wrong with it."""
    try:
        config = yaml.load((run / CONFIG_FILE).read_text(encoding="utf-8"), Loader=_Loader)
    except (OSError, ValueError, yaml.YAMLError) as error:
        return {}, f"{CONFIG_FILE} cannot be read: {type(error).__name__}"
    if not isinstance(config, dict) or not config:
        return {}, f"{CONFIG_FILE} holds no configuration"
    return config, None


def _last_epoch(run: RunDirectory) -> dict[str, Any]:
    try:
        return (read_epochs(run) or [{}])[-1]
    except (OSError, ValueError, AttributeError):  # not the lines that a run writes
        return {}


def _fits(value: Any, pattern: str | None) -> bool:
    """Tell whether an id or name fits a pattern; an id without its version fits too."""
    if pattern is None:
        return True
    names = (str(value), re.sub(r"-v\d+$", "", str(value)))
    return any(fnmatchcase(name.lower(), pattern.lower()) for name in names)
