"""What it costs to evaluate, to track and to declare metrics, in time per training step.

Runs of `jaxsac` on FetchReach, each in a process of its own, differ in one thing only: nothing is
switched on, and the same again, which shows how much is chance; MLflow; TensorBoard; probes that
are declared with ``render=record`` but not shown; evaluation as often as by default, 5 episodes per
1,000 steps. They take turns in the order A B B A, an epoch each, while the others wait.

Prints a table and one JSON object with, per row, ``steps_per_second``, and ``ratio``: the time of
an epoch relative to that of the first row in the same turn, with ``interval``, 95 % of the
bootstrapped medians; ``cpu_ratio`` and its interval: the same of the processor time (bar: at most
1.01 for declared metrics). Evaluation counts only in its own row; elsewhere the one episode that
every epoch needs is taken off. What a tracker writes in a thread of its own counts until it is
written, although training would not wait for it.

Run: python benchmarks/cost.py [--rounds N] [--steps N] [--json FILE] [KEY=VALUE ...]
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from turns import Seconds, publish, relative, take_turns

BASE = "nothing"
EVALUATION = "evaluation"
PATIENCE_SECONDS = 120.0
PROBES = "[q_value,critic_variance,goal_distance,reward]"
_FEW_EPISODES = ("n_test_rollouts=1",)
VARIANTS = {
    BASE: _FEW_EPISODES,
    "nothing, again": _FEW_EPISODES,
    "mlflow": (*_FEW_EPISODES, "mlflow=1"),
    "tensorboard": (*_FEW_EPISODES, "tensorboard=1"),
    "declared metrics": (
        *_FEW_EPISODES, "render=record", "render_freq=1000000",
        f"render_metrics_train={PROBES}", f"render_metrics_test={PROBES}",
    ),
    EVALUATION: ("n_test_rollouts=5",),
}  # fmt: skip
Rows = dict[str, dict[str, Any]]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=6, help="of two turns each; default 6")
    parser.add_argument("--steps", type=int, default=1000, help="per turn; default 1000")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="for every run")
    arguments = parser.parse_intermixed_args()
    given = (f"eval_after_n_steps={arguments.steps}", *arguments.overrides)
    with tempfile.TemporaryDirectory() as folder:
        runs = {
            name: Run((*words, *given, f"base_logdir={folder}/{index}"))
            for index, (name, words) in enumerate(VARIANTS.items())
        }
        for run in runs.values():  # compiles, begins to learn, fills what is filled once
            run.epoch()
        epochs = {
            name: partial(run.epoch, with_evaluation=name == EVALUATION)
            for name, run in runs.items()
        }
        times = take_turns(epochs, arguments.rounds)
        for run in runs.values():
            run.end()
    rows = {name: compare(taken, times[BASE], arguments.steps) for name, taken in times.items()}
    publish(table(rows), rows, arguments.json)


def compare(taken: list[Seconds], base: list[Seconds], n_steps: int) -> dict[str, Any]:
    """Return a row."""
    wall = relative([t.wall for t in taken], [t.wall for t in base])
    cpu = relative([t.cpu for t in taken], [t.cpu for t in base])
    return {
        "steps_per_second": n_steps / statistics.median(t.wall for t in taken),
        **wall,
        "cpu_ratio": cpu["ratio"],
        "cpu_interval": cpu["interval"],
    }


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
    import hydra

    from scilab_rl import config, experiment
    from scilab_rl.training import trainer

    watcher = Watcher(connection, trainer.evaluate)
    trainer.evaluate = watcher.evaluate
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        cfg = config.compose(
            [
                "algorithm=jaxsac", "env=FetchReach-v4", "seed=1", "n_epochs=1000000",
                "early_stop_threshold=2", "mlflow=0", "++tracking.console.enabled=false",
                *overrides,
            ]
        )  # fmt: skip
        experiment.run(cfg, watch=watcher.watch)


class Watcher:
    """Lets a run wait between its epochs, and tells how long they take.

    Args:
        connection: To the benchmark.
        evaluate: What evaluates the policy.
    """

    def __init__(self, connection: Connection, evaluate: Callable[..., Any]) -> None:
        self._connection = connection
        self._evaluate = evaluate
        self._begun = self._evaluation = Seconds(0.0, 0.0)
        self._trackers: list[Any] = []
        self._written = threading.Semaphore(0)

    def watch(self, session: Any) -> None:
        """Attach to a run that is about to begin."""
        from scilab_rl.tracking.mirror import Mirror

        self._trackers = [t for t in session.trackers.trackers if isinstance(t, Mirror)]
        for mirror in self._trackers:
            mirror.tracker.epoch = followed_by(self._written.release, mirror.tracker.epoch)
        session.trainer.may_go_on.append(self.end_epoch)
        self._connection.send("ready")
        self.wait()

    def evaluate(self, *arguments: Any) -> Any:
        """Evaluate, and note how long it takes."""
        started = Seconds.now()
        outcome = self._evaluate(*arguments)
        self._evaluation = Seconds.now() - started
        return outcome

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


def table(rows: Rows) -> str:
    """Return the results as a table."""
    lines = [f"{'switched on':20}{'steps/s':>9}{'ratio':>8}{'95 %':>16}{'cpu':>8}{'95 %':>16}"]
    for name, row in rows.items():
        (low, high), (cpu_low, cpu_high) = row["interval"], row["cpu_interval"]
        lines.append(
            f"{name:20}{row['steps_per_second']:9.1f}{row['ratio']:8.3f}"
            f"{f'{low:.3f} - {high:.3f}':>16}{row['cpu_ratio']:8.3f}"
            f"{f'{cpu_low:.3f} - {cpu_high:.3f}':>16}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
