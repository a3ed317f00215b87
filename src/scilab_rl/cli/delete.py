"""``scilab-rl delete RUN ...``: remove runs, after a question."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import sys
from pathlib import Path

from scilab_rl import files
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.runs import as_clock
from scilab_rl.cli.tables import print_rows
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError, first_line
from scilab_rl.run.directory import CONFIG_FILE, LAST_LINK, RunDirectory, all_runs, find_run
from scilab_rl.run.facts import read_run
from scilab_rl.search.folders import study_names

_log = logging.getLogger(__name__)
_COLUMNS = ("id", "started", "env", "algorithm", "status", "success", "time", "size", "note")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    base = options.base_logdir
    found = [find_run(word, base) for word in options.runs]
    runs = list({run.path: run for run in found}.values())
    for run in runs:
        _refuse(run)
    _show(runs, base)
    if not options.yes and not _confirmed(len(runs)):
        _log.info("Nothing has been removed.")
        return 1
    for run in runs:
        if options.mlflow:
            _delete_from_mlflow(run)
        remove_run(run)
        _log.info("Removed %s.", run)
    return 0


def remove_run(run: RunDirectory) -> None:
    """Remove a run's directory; ``last`` then points to the newest that is left.

    It is renamed first, so that one that is half removed is never taken for a run.

    Raises:
        ConfigError: If a process works on it, or if it is an agent.
    """
    base = run.path.resolve().parents[1]
    is_last = (base / LAST_LINK).resolve() == run.path.resolve()
    _refuse(run)
    files.discard(run.path)
    if is_last:
        (base / LAST_LINK).unlink(missing_ok=True)
        if left := list(all_runs(base)):
            left[-1].publish_as_last(base)
    if not any(run.path.parent.iterdir()):
        run.path.parent.rmdir()


def _refuse(run: RunDirectory) -> None:
    run.refuse_agent()
    if run.is_in_use():
        raise ConfigError(f"A process works on '{run}': stop it first. Nothing has been removed.")


def _show(runs: list[RunDirectory], base: Path) -> None:
    records = [read_run(run, study_names(base)) for run in runs]
    rows = [
        {**record, "time": as_clock(record["seconds"]), "size": _size(run.path)}
        for run, record in zip(runs, records, strict=True)
    ]
    print_rows(_COLUMNS, rows, optional=("time", "started", "algorithm"), if_any=("note",))
    for study in {record["study"] for record in records} - {None}:
        _log.warning("Runs of the study %s: its report keeps their scores, without files.", study)


def _size(path: Path) -> str:
    n_bytes = sum(file.lstat().st_size for file in path.rglob("*") if file.is_file())
    return f"{n_bytes / 2**20:.1f} MiB"


def _confirmed(n_runs: int) -> bool:
    """Ask on the terminal; without one, the answer must be on the command line."""
    if not sys.stdin.isatty():
        raise ConfigError("delete asks before it removes runs; without a terminal, add --yes.")
    sys.stderr.write(f"Remove {'this run' if n_runs == 1 else f'these {n_runs} runs'}? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _delete_from_mlflow(run: RunDirectory) -> None:
    """Move a run in MLflow to its trash.

    Raises:
        ConfigError: If the configuration of the run cannot be read.
        ScilabRLError: If MLflow cannot be reached.
    """
    import importlib.util

    from scilab_rl.config.recorded import load_recorded
    from scilab_rl.tracking.base import TrackedRun

    if importlib.util.find_spec("mlflow") is None:
        raise MissingDependencyError("mlflow", "mlflow", "to delete runs there")
    from scilab_rl.tracking.mlflow import MLflowTracker

    cfg = load_recorded(run / CONFIG_FILE, makes_env=False)
    cfg = dataclasses.replace(cfg, base_logdir=str(run.path.parents[1]))  # it may have moved
    tracker = MLflowTracker(cfg.tracking.get("mlflow", {}).get("tracking_uri"))
    try:
        was_there = tracker.delete(TrackedRun(cfg, run.path))
    except Exception as error:
        raise ScilabRLError(
            f"MLflow did not delete '{run}': {first_line(error).rstrip('.')}. The run is still "
            "here; without --mlflow, only its folder is removed."
        ) from error
    if not was_there:
        _log.info("MLflow does not know %s.", run.path.name)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("delete", "Remove runs with all their files; asks first.", base=True)
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="'last', a run's id or path, or a part of its name")
    add("--yes", action="store_true", help="do not ask")
    add("--mlflow", action="store_true", help="also remove it from MLflow (to its trash)")
    return parser.parse_args(arguments)
