"""The worker process, which trains one run after the other."""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import logging
import os
import signal
import socket
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:  # heavy
    from scilab_rl.results import RunResult
    from scilab_rl.training.callbacks import RunCallback

LAST_WORDS = ("finished", "failed", "died")  # kinds of the message that ends a run
_PR_SET_PDEATHSIG = 1
_OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "cannot allocate memory")


@dataclass(frozen=True)
class Task:
    """A run to train.

    Attributes:
        overrides: Its configuration, as typed on a command line.
        criterion: The metric to report at each evaluation.
        run_dir: An interrupted run to continue from its newest checkpoint, if it has one.
        n_final_episodes: Evaluation episodes of the finished policy, on a seed of their own.
    """

    overrides: tuple[str, ...]
    criterion: str
    run_dir: str = ""
    n_final_episodes: int = 0


@dataclass(frozen=True)
class Message:
    """A message from a worker to the study.

    Attributes:
        kind: ``ready``, ``started``, ``evaluated`` (answered with whether to continue),
            ``finished``, ``failed`` or, sent by the pool for a dead worker, ``died``.
        content: What belongs to the kind.
    """

    kind: str
    content: Mapping[str, Any] = field(default_factory=dict)


class Channel(Protocol):
    """A run's end of the line to its study."""

    def send(self, message: Message, /) -> None:
        """Say something."""

    def recv(self) -> bool:
        """Wait for the answer to an evaluation: whether to continue."""


def main(connection: Connection, log_path: str, n_threads: int) -> None:
    """Train what comes through the connection until it closes.

    Args:
        connection: To the pool.
        log_path: File for everything that is printed here.
        n_threads: Threads for numerical libraries.
    """
    _die_with_parent()
    os.setsid()  # Ctrl-C on the terminal is for the study, which lets the running trials end
    os.environ["OMP_NUM_THREADS"] = str(n_threads)
    _print_to(log_path)

    connection.send(Message("ready"))
    with contextlib.suppress(EOFError, OSError):  # the study has ended
        while (task := connection.recv()) is not None:
            connection.send(train(task, connection))


def train(task: Task, channel: Channel) -> Message:
    """Train one run and return what has become of it.

    Args:
        task: The run.
        channel: To the study, for what happens meanwhile.
    """
    try:
        return Message("finished", _run(task, channel))
    except (EOFError, BrokenPipeError):
        raise
    except Exception as error:  # noqa: BLE001 - a crash is a result, whatever it is
        text = " ".join(str(error).split()) or type(error).__name__
        return Message("failed", {"error": text, "machine": _blames_machine(error)})


def _run(task: Task, channel: Channel) -> dict[str, object]:
    from scilab_rl.metrics.criteria import criterion_curve, criterion_of
    from scilab_rl.run.directory import RunDirectory, read_epochs
    from scilab_rl.run.player import measure_run
    from scilab_rl.training.callbacks import Pruning
    from scilab_rl.training.loop import Trainer

    told_to_stop = False

    def should_continue(step: int, epoch: int, values: Mapping[str, float]) -> bool:
        nonlocal told_to_stop
        value = criterion_of(values, task.criterion)
        channel.send(Message("evaluated", {"epoch": epoch, "step": step, "value": value}))
        told_to_stop = not channel.recv()
        return not told_to_stop

    class Reporting(Pruning):
        """Reports the run's beginning, too."""

        def begin(self, trainer: Trainer) -> None:
            place = f"{socket.gethostname()}:{trainer.run_dir.resolve()}"
            content = {"run_dir": str(trainer.run_dir), "place": place}
            channel.send(Message("started", content))

    result = _start_or_continue(task, Reporting(should_continue))
    # The file holds the whole curve, also of a run that was continued.
    rows = read_epochs(RunDirectory(Path(result.run_dir)))
    final = None
    if task.n_final_episodes and not told_to_stop:
        measured = measure_run(RunDirectory(Path(result.run_dir)), task.n_final_episodes)
        final = criterion_of(measured, task.criterion)
    return {
        "status": "pruned" if told_to_stop else result.status,
        "final": final,
        "run_dir": result.run_dir,
        "seconds": result.seconds,
        "steps": [row["step"] for row in rows],
        "values": criterion_curve(rows, task.criterion),
    }


def _start_or_continue(task: Task, callback: RunCallback) -> RunResult:
    from scilab_rl.config.compose import compose
    from scilab_rl.config.recorded import load_recorded
    from scilab_rl.config.workspace import open_project
    from scilab_rl.errors import CheckpointError, ConfigError
    from scilab_rl.run.directory import CONFIG_FILE, RunDirectory
    from scilab_rl.run.run import resume_run, start_run

    open_project()
    cfg, directory = compose(task.overrides), RunDirectory(Path(task.run_dir))
    if task.run_dir:
        # Without a whole checkpoint or configuration, the run restarts.
        with contextlib.suppress(CheckpointError, ConfigError):
            recorded = load_recorded(directory / CONFIG_FILE, typed_env=cfg.env)
            return resume_run(recorded, directory, [callback])
    return start_run(cfg, task.overrides, [callback])


def _blames_machine(error: BaseException | None) -> bool:
    """Return whether the cause is the machine, so that another attempt may succeed."""
    while error is not None:
        if isinstance(error, MemoryError) or any(w in str(error).lower() for w in _OUT_OF_MEMORY):
            return True
        error = error.__cause__
    return False


def _die_with_parent() -> None:
    """Let the kernel end this process when its parent dies, even by ``kill -9`` (Linux only)."""
    parent = os.getppid()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has just died
        os._exit(1)


def _print_to(log_path: str) -> None:
    """Send everything that is printed, also by libraries and at a crash, to a file."""
    descriptor = os.open(log_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    faulthandler.enable()
    logger = logging.getLogger("scilab_rl")
    logger.addHandler(logging.StreamHandler(sys.stderr))
    logger.setLevel(logging.INFO)
    logger.propagate = False
