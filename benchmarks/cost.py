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
import statistics
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from participants import Run
from turns import Seconds, publish, relative, take_turns

BASE = "nothing"
EVALUATION = "evaluation"
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
    given = (
        "algorithm=jaxsac", f"eval_after_n_steps={arguments.steps}", *arguments.overrides,
    )  # fmt: skip
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
