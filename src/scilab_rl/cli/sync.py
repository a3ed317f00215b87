"""``scilab-rl sync RUN``: send runs to a tracker that was unavailable while they trained."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import logging
from pathlib import Path

from scilab_rl.cli.parser import CommandParser
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError, first_line
from scilab_rl.redaction import REDACTED
from scilab_rl.results import RunResult
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, all_runs, find_run, read_epochs
from scilab_rl.tracking.base import SyncableTracker

_log = logging.getLogger(__name__)
_SENT = (".mp4", ".html")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_project()
    if options.to != "wandb" and not importlib.util.find_spec(options.to):
        raise MissingDependencyError(options.to, options.to, "to send runs there")
    send = _log_wandb_command if options.to == "wandb" else _send
    if options.run != "all":
        run = find_run(options.run, options.base_logdir)
        run.refuse_agent()
        send(run, options)
        return 0
    n_failed = 0
    for run in all_runs(options.base_logdir):
        try:
            send(run, options)
        except ConfigError as error:  # concerns this run; an unavailable tracker would concern all
            n_failed += 1
            _log.warning("%s: %s", run.path.name, error)
    return int(n_failed > 0)


def _send(run: RunDirectory, options: argparse.Namespace) -> None:
    """Send what is missing of a run.

    Raises:
        ConfigError: If the run is still being trained, or cannot be read.
        ScilabRLError: If the tracker cannot be reached.
    """
    from scilab_rl.tracking.base import TrackedRun
    from scilab_rl.tracking.sync import sync

    with run.in_use():
        cfg = load_recorded(run / CONFIG_FILE, makes_env=False)
        cfg = dataclasses.replace(cfg, base_logdir=str(run.path.parents[1]))  # it may have moved
        tracker = _tracker(cfg, options)
        result, epochs = _ended(run), read_epochs(run)
        tracked = TrackedRun(cfg, run.path)
        try:
            sent = sync(tracker, tracked, epochs, _files(run), result)
        except Exception as error:
            raise ScilabRLError(
                f"{options.to} did not accept '{run}': {first_line(error).rstrip('.')}. What was "
                "sent is kept; the same command sends the rest."
            ) from error
    if sent is None:
        _log.info("%s: already complete", run.path.name)
    else:
        _log.info("%s: %d values and %d files sent", run.path.name, *sent)


def _tracker(cfg: RunConfig, options: argparse.Namespace) -> SyncableTracker:
    if options.to == "tensorboard":
        from scilab_rl.tracking.tensorboard import TensorBoardTracker

        return TensorBoardTracker()
    from scilab_rl.tracking.mlflow import MLflowTracker

    uri = options.uri or cfg.tracking.get("mlflow", {}).get("tracking_uri")
    if uri and REDACTED in uri:
        raise ConfigError(f"Runs do not store passwords: pass the address '{uri}' with --uri.")
    return MLflowTracker(uri)


def _files(run: RunDirectory) -> list[Path]:
    """Return the videos and pages of recorded episodes."""
    return sorted(path for path in (run / "episodes").glob("*") if path.suffix in _SENT)


def _ended(run: RunDirectory) -> RunResult:
    """Return the result of a run; a killed one counts as interrupted."""
    result = run.read_result() or RunResult("running", None, 0, 0, 0.0, str(run))
    if result.status == "running":
        return dataclasses.replace(result, status="interrupted")
    return result


def _log_wandb_command(run: RunDirectory, options: argparse.Namespace) -> None:
    """Log W&B's own command, which keeps track of uploads itself."""
    folders = sorted((run / "wandb").glob("offline-run-*"))
    for folder in folders:
        _log.info("wandb sync %s", folder)
    if not folders:
        _log.info("%s: nothing to upload to W&B", run.path.name)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "sync", "Send ended runs to a tracker that was unavailable while they trained.", base=True
    )
    add = parser.add_argument
    add("run", help="'last', a run's id or path, a part of its name, or 'all'")
    add("--to", choices=("mlflow", "tensorboard", "wandb"), default="mlflow",
        help="default: mlflow; for wandb, its own command is printed")  # fmt: skip
    add("--uri", help="address of an MLflow server; default: the run's own, or the local database")
    return parser.parse_args(arguments)
