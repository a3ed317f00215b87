"""Seconds and steps until a goal is mastered: compiled algorithms beside Stable-Baselines3's SAC.

Each run is the command a user would type, one after the other in turns (all recipes with the first
seed, then with the second), and ends after three evaluations of 20 episodes in a row with a success
rate of at least 0.9. Time is that of training, evaluations excluded, start-up and compiling
included. The peer has the values that RL Baselines3 Zoo and the paper's authors publish.

Prints a table with medians over the seeds and one JSON object with every run and its curve.

Run: python benchmarks/time_to_success.py reach|push|pick|slide [--seeds N] [--first-seed N]
[--only NAME ...]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from scilab_rl.run.directory import RunDirectory, read_epochs

ROOT = Path(__file__).parents[1]
THRESHOLD, IN_A_ROW, EPISODES = 0.9, 3, 20
PEER = "stable-baselines3 sac"


class Task(NamedTuple):
    """An environment, when it is evaluated, how long a run may take, and what runs."""

    env: str
    eval_after_n_steps: int
    max_steps: int
    recipes: dict[str, tuple[str, ...]]


HER = "algorithm.replay_buffer_class=her"
COMPILED = {name: (f"algorithm={name}",) for name in ("jaxsac", "jaxtd3")}
TASKS = {
    "reach": Task(
        "FetchReach-v4",
        1000,
        20_000,
        {
            **COMPILED,
            "cleansac": ("algorithm=cleansac",),
            PEER: ("algorithm=sac", HER),
        },
    ),
    "push": Task("FetchPush-v4", 20_000, 600_000, COMPILED),
    "pick": Task("FetchPickAndPlace-v4", 20_000, 600_000, COMPILED),
    "slide": Task("FetchSlide-v4", 20_000, 600_000, COMPILED),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--seeds", type=int, default=3, help="how many; default 3")
    parser.add_argument("--first-seed", type=int, default=1)
    known = sorted({name for task in TASKS.values() for name in task.recipes})
    parser.add_argument("--only", nargs="*", choices=known, help="names of recipes; put last")
    parser.add_argument("--logdir", type=Path, help="keep the runs in this folder")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="for every run")
    arguments = parser.parse_intermixed_args()
    task = TASKS[arguments.task]
    names = [name for name in task.recipes if not arguments.only or name in arguments.only]
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
            for name in names:
                folder = (arguments.logdir or Path(scratch)) / f"{name.split()[0]}-{seed}"
                overrides = (*task.recipes[name], *arguments.overrides)
                runs[name].append(train(task, overrides, seed, folder))
                sys.stdout.write(f"{name} seed {seed}: {line(runs[name][-1])}\n")
                sys.stdout.flush()
    report = {"env": task.env, "load_average": os.getloadavg()[0], "runs": runs}
    sys.stdout.write(f"{table(runs)}\n{json.dumps(report)}\n")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def train(task: Task, overrides: tuple[str, ...], seed: int, folder: Path) -> dict[str, Any]:
    """Run one training and read what it has recorded."""
    command = [
        sys.executable, str(ROOT / "src" / "main.py"), f"env={task.env}", f"seed={seed}",
        f"eval_after_n_steps={task.eval_after_n_steps}", f"n_test_rollouts={EPISODES}",
        f"n_epochs={task.max_steps // task.eval_after_n_steps}", "mlflow=0", "wandb=0",
        f"early_stop_threshold={THRESHOLD}", f"early_stop_last_n={IN_A_ROW}",
        f"base_logdir={folder}", *overrides,
    ]  # fmt: skip
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, cwd=ROOT, env=environment, capture_output=True)
    epochs = read_epochs(RunDirectory((folder / "last").resolve()))
    success = [row["eval/success_rate"] for row in epochs]
    row_of_three = [
        end
        for end in range(IN_A_ROW, len(success) + 1)
        if statistics.mean(success[end - IN_A_ROW : end]) >= THRESHOLD
    ]
    end = row_of_three[0] if row_of_three else None
    seconds = [row["time/train_seconds"] for row in epochs]
    return {
        "steps": epochs[end - 1]["step"] if end else None,
        "seconds": sum(seconds[:end]) if end else None,
        "total_seconds": sum(seconds),
        "curve": {"steps": [row["step"] for row in epochs], "success": success},
    }


def line(run: dict[str, Any]) -> str:
    """Return one run in words."""
    if run["steps"] is None:
        return f"not mastered after {run['total_seconds']:.0f} s, {run['curve']['success'][-3:]}"
    return f"{run['steps']:.0f} steps, {run['seconds']:.1f} s"


def table(runs: dict[str, list[dict[str, Any]]]) -> str:
    """Return medians over seeds; a run that never got there counts as endless."""
    lines = [f"{'recipe':24}{'mastered':>10}{'steps':>10}{'seconds':>10}{'peer/ours':>11}"]
    medians = {
        name: statistics.median(run["seconds"] or float("inf") for run in group)
        for name, group in runs.items()
    }
    for name, group in runs.items():
        reached = sum(run["steps"] is not None for run in group)
        steps = statistics.median(run["steps"] or float("inf") for run in group)
        ratio = medians[PEER] / medians[name] if PEER in medians else float("nan")
        lines.append(
            f"{name:24}{f'{reached}/{len(group)}':>10}{steps:>10.0f}{medians[name]:>10.1f}"
            f"{ratio:>11.1f}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
