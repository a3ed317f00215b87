"""``scilab-rl sync RUN``: send runs to a tracker that was away while they trained."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from scilab_rl.commands.parser import CommandParser
from scilab_rl.config import load_recorded
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError
from scilab_rl.masking import MASK
from scilab_rl.results import (
    CONFIG_FILE,
    RunDirectory,
    RunResult,
    all_runs,
    find_run,
    read_epochs,
)
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)
_SENT = (".mp4", ".html")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_desk()
    if options.to != "wandb" and not importlib.util.find_spec(options.to):
        raise MissingDependencyError(options.to, options.to, "to send runs there")
    send = _say_how_to_sync_wandb if options.to == "wandb" else _send
    if options.run != "all":
        send(find_run(options.run, options.base_logdir), options)
        return 0
    n_failed = 0
    for run in all_runs(options.base_logdir):
        try:
            send(run, options)
        except ConfigError as error:  # of this run; a tracker that is away would be for all
            n_failed += 1
            _log.warning("%s: %s", run.path.name, error)
    return int(n_failed > 0)


def _send(run: RunDirectory, options: argparse.Namespace) -> None:
    """Send what is missing of a run.

    Raises:
        ConfigError: If the run is still being trained, or cannot be read.
        ScilabRLError: If the tracker cannot be reached.
    """
    from scilab_rl.experiment import run_info
    from scilab_rl.tracking.sync import sync

    with run.in_use():
        cfg = load_recorded(run / CONFIG_FILE)
        cfg.base_logdir = str(run.path.parents[1])  # it may have moved
        tracker = _tracker(cfg, options)
        result, epochs = _ended(run), read_epochs(run)
        info = run_info(cfg, run, cfg.n_epochs * cfg.eval_after_n_steps, None)
        try:
            sent = sync(tracker, info, epochs, list(_files(run)), result)
        except Exception as error:
            raise ScilabRLError(
                f"{options.to} does not take '{run}': {_first_line(error)} What it has is kept; "
                "the same command sends the rest."
            ) from error
    if sent is None:
        _log.info("%s: complete there already", run.path.name)
    else:
        _log.info("%s: %d values and %d files sent", run.path.name, *sent)


def _tracker(cfg: Any, options: argparse.Namespace) -> Any:
    if options.to == "tensorboard":
        from scilab_rl.tracking.tensorboard import TensorBoardTracker

        return TensorBoardTracker()
    from scilab_rl.tracking.mlflow import MLflowTracker

    uri = options.uri or OmegaConf.select(cfg, "tracking.mlflow.tracking_uri")
    if uri and MASK in uri:
        raise ConfigError(f"A run does not keep passwords: give the address '{uri}' with --uri.")
    return MLflowTracker(uri)


def _ended(run: RunDirectory) -> RunResult:
    """Return how a run ended; one that was killed has not said so."""
    result = run.read_result() or RunResult("running", None, 0, 0, 0.0, str(run))
    if result.status == "running":
        return dataclasses.replace(result, status="interrupted")
    return result


def _files(run: RunDirectory) -> Iterator[Path]:
    """Yield the videos and pages of recorded episodes."""
    for path in sorted((run / "episodes").glob("*")):
        if path.suffix in _SENT:
            yield path


def _say_how_to_sync_wandb(run: RunDirectory, options: argparse.Namespace) -> None:
    """Name W&B's own command, which knows what it has uploaded already."""
    folders = sorted((run / "wandb").glob("offline-run-*"))
    for folder in folders:
        _log.info("wandb sync %s", folder)
    if not folders:
        _log.info("%s: nothing of it waits for W&B", run.path.name)


def _first_line(error: Exception) -> str:
    line = str(error).strip().partition("\n")[0] or type(error).__name__
    return line if line.endswith(".") else f"{line}."


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("sync", "Send what a tracker has missed of runs that have ended.")
    add = parser.add_argument
    add("run", help="'last', the path of a run, a part of its name, or 'all'")
    add("--to", choices=("mlflow", "tensorboard", "wandb"), default="mlflow",
        help="default: mlflow; for wandb, its own command is printed")  # fmt: skip
    add("--uri", help="address of an MLflow server; default: the run's own, or the local database")
    add("--base-logdir", type=Path, default=Path("data"), help="default: data")
    return parser.parse_args(arguments)
