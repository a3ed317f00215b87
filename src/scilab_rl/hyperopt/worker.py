"""What happens inside a worker process: it trains one run after the other, as it is told."""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import logging
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

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
    """What a worker says to the study.

    Attributes:
        kind: ``ready``, ``started``, ``evaluated`` (answered with whether to go on), ``finished``,
            ``failed`` or, said by the pool on behalf of the dead, ``died``.
        content: What belongs to the kind.
    """

    kind: str
    content: Mapping[str, Any] = field(default_factory=dict)


class Channel(Protocol):
    """A run's end of the line to its study."""

    def send(self, message: Message, /) -> None:
        """Say something."""

    def recv(self) -> Any:
        """Wait for the answer to an evaluation: whether to go on."""


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
    from scilab_rl import experiment  # noqa: F401 - the slow import, once per worker

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


def _run(task: Task, channel: Channel) -> dict[str, Any]:
    from scilab_rl import experiment
    from scilab_rl.results import RunDirectory, read_epochs

    told_to_stop = False

    def may_go_on(step: int, epoch: int, values: Mapping[str, float]) -> bool:
        nonlocal told_to_stop
        value = experiment.criterion_of(values, task.criterion)
        channel.send(Message("evaluated", {"epoch": epoch, "step": step, "value": value}))
        told_to_stop = not channel.recv()
        return not told_to_stop

    def watch(session: experiment.Session) -> None:
        session.trainer.may_go_on.append(may_go_on)
        channel.send(Message("started", {"run_dir": str(session.directory)}))

    result = _start_or_continue(task, watch)
    # The file holds the whole curve, also of a run that was continued.
    rows = read_epochs(RunDirectory(Path(result.run_dir)))
    final = None
    if task.n_final_episodes and not told_to_stop:
        measured = experiment.measure(RunDirectory(Path(result.run_dir)), task.n_final_episodes)
        final = experiment.criterion_of(measured, task.criterion)
    return {
        "status": "pruned" if told_to_stop else result.status,
        "final": final,
        "run_dir": result.run_dir,
        "seconds": result.seconds,
        "steps": [row["step"] for row in rows],
        "values": [experiment.criterion_of(row, task.criterion) for row in rows],
    }


def _start_or_continue(task: Task, watch: Any) -> Any:
    from scilab_rl import config, experiment
    from scilab_rl.errors import CheckpointError, ConfigError
    from scilab_rl.results import CONFIG_FILE, RunDirectory

    directory = RunDirectory(Path(task.run_dir))
    if task.run_dir:
        # Without a whole checkpoint or configuration, the run begins anew.
        with contextlib.suppress(CheckpointError, ConfigError):
            return experiment.resume(
                config.load_recorded(directory / CONFIG_FILE), directory, watch=watch
            )
    return experiment.run(_compose(task.overrides), task.overrides, watch=watch)


def _compose(overrides: tuple[str, ...]) -> Any:
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    from scilab_rl.config import compose
    from scilab_rl.workspace import open_desk

    if not GlobalHydra.instance().is_initialized():
        open_desk()
        hydra.initialize_config_module("scilab_rl.conf", version_base="1.3")
    return compose(overrides)


def _blames_machine(error: BaseException | None) -> bool:
    """Tell whether the cause is the machine, so that another attempt may succeed."""
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
