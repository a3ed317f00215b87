"""Who takes part in a comparison: our runs, and peers in a virtual environment of their own."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from turns import Seconds

from scilab_rl.tracking.background import BackgroundTracker
from scilab_rl.training.callbacks import Pruning, ReportToTrackers
from scilab_rl.training.loop import Trainer

PATIENCE_SECONDS = 120.0
PEERS_PYTHON = Path(__file__).parents[1] / ".venv-peers" / "bin" / "python"


def peers_are_installed() -> bool:
    """Return whether there are peers, and if not, how they are installed."""
    if not PEERS_PYTHON.exists():
        sys.stdout.write("Some peers are missing: `make .venv-peers/.installed` installs them.\n")
    return PEERS_PYTHON.exists()


class Peer:
    """A peer, which works when it is told to.

    Args:
        script: Below `peers/`.
        words: What it is given on its command line.
        n_threads: Of its matrix products.
    """

    def __init__(self, script: str, *words: object, n_threads: int = 1) -> None:
        path = Path(__file__).parent / "peers" / script
        process = subprocess.Popen(
            list(map(str, [PEERS_PYTHON, path, *words])),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": str(n_threads)},
        )
        assert process.stdin is not None and process.stdout is not None
        self._requests, self._answers = process.stdin, process.stdout
        if not self._answers.readline():  # it would be ready
            raise SystemExit(f"{path} has failed, see above.")

    def do(self, n: int) -> float:
        """Let it work, and return the seconds of processor time that it took."""
        self._requests.write(f"{n}\n")
        self._requests.flush()
        return float(self._answers.readline())


class Run:
    """A run in a process of its own, which learns for an epoch whenever it is told to.

    Args:
        overrides: Of the configuration.
    """

    def __init__(self, overrides: Sequence[str]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=learn_in_turns, args=(theirs, overrides))
        self._process.start()
        theirs.close()
        self._connection.recv()  # it is ready

    def epoch(self, *, with_evaluation: bool = False) -> Seconds:
        """Let it learn for an epoch."""
        self._connection.send(True)
        seconds, evaluation = self._connection.recv()
        return seconds if with_evaluation else seconds - evaluation

    def end(self) -> None:
        """Let it end."""
        self._connection.send(False)
        self._process.join()


def learn_in_turns(connection: Connection, overrides: Sequence[str]) -> None:
    """Train, and wait for permission before each epoch."""
    from scilab_rl.config.compose import compose
    from scilab_rl.run.run import start_run

    cfg = compose(
        [
            "env=FetchReach-v4", "seed=1", "n_epochs=1000000", "early_stop_threshold=2",
            "mlflow=0", "++tracking.console.enabled=false", *overrides,
        ]
    )  # fmt: skip
    start_run(cfg, callbacks=[Watcher(connection)])


class Watcher(Pruning):
    """Lets a run wait between its epochs, and tells how long they take.

    Args:
        connection: To the benchmark.
    """

    def __init__(self, connection: Connection) -> None:
        super().__init__(self.end_epoch)
        self._connection = connection
        self._begun = self._evaluation = Seconds(0.0, 0.0)
        self._trackers: list[Any] = []
        self._written = threading.Semaphore(0)

    def begin(self, trainer: Trainer) -> None:
        """Attach to a run that is about to begin."""
        reporting = next(c for c in trainer.callbacks if isinstance(c, ReportToTrackers))
        trackers = reporting.trackers.trackers
        self._trackers = [t for t in trackers if isinstance(t, BackgroundTracker)]
        for mirror in self._trackers:
            mirror.tracker.epoch = followed_by(self._written.release, mirror.tracker.epoch)
        self._evaluate = trainer.evaluate
        trainer.evaluate = self.evaluate
        self._connection.send("ready")
        self.wait()

    def evaluate(self) -> dict[str, float]:
        """Evaluate, and note how long it takes."""
        started = Seconds.now()
        values = self._evaluate()
        self._evaluation = Seconds.now() - started
        return values

    def end_epoch(self, _step: int, _epoch: int, _values: Mapping[str, float]) -> bool:
        """Report, and wait for the next turn."""
        for tracker in self._trackers:
            if not self._written.acquire(timeout=PATIENCE_SECONDS):
                raise SystemExit(f"{tracker.label} does not write what it is told.")
        self._connection.send((Seconds.now() - self._begun, self._evaluation))
        return self.wait()

    def wait(self) -> bool:
        """Wait for the turn, and return whether there is one."""
        go_on = self._connection.recv()
        self._begun = Seconds.now()
        return go_on


def followed_by(tell: Callable[[], object], call: Callable[..., object]) -> Callable[..., None]:
    """Return a call that tells when it is done."""

    def call_and_tell(*arguments: Any) -> None:
        call(*arguments)
        tell()

    return call_and_tell
