"""How speed changes with size: environments side by side, networks, batches.

* ``environments``: steps per second of a task (``--task``, FetchReach) with random actions, for 1
  to 8 environments in one process, there in one thread per core, in one process per core and in a
  process each; and of EnvPool's (Fetch only) with one thread and with one per core. Beside it, the
  processor time of a step in all processes, which other work on the machine disturbs less;
* ``updates``: ms per update of `cleansac` and `jaxsac` as width, depth and batch grow, beside the
  matrix products that SAC cannot do without (the row of that name in `updates.py`).

All that is compared takes turns in the order A B B A; reported are medians.

Prints a table per part and one JSON object.

Run: python benchmarks/scaling.py [--task ENVIRONMENT] [--rounds N] [--steps N]
[--sizes BATCH,LAYER,... ...] [--n-envs N ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
import updates
from participants import Peer, peers_are_installed
from turns import publish, relative, take_turns, timed

from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.envs.vectorize import make_train_env, observed_layer
from scilab_rl.machine import n_cores

N_ENVS = (1, 2, 4, 8)
VECTORS = ("inprocess", "threads", "workers", "subprocess")
# Batch size and hidden layers: width, depth and batch around 256 and [256, 256].
SIZES = (
    "256,64,64", "256,128,128", "256,256,256", "256,512,512", "256,1024,1024",
    "256,256", "256,256,256,256", "256,256,256,256,256",
    "64,256,256", "512,256,256", "1024,256,256", "2048,256,256",
)  # fmt: skip
ROWS = ("cleansac", "jaxsac", updates.PRODUCTS)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="FetchReach-v4", help="whose environments are stepped")
    parser.add_argument("--rounds", type=int, default=10, help="of two turns each; default 10")
    parser.add_argument("--steps", type=int, default=50, help="of all environments, per turn")
    parser.add_argument("--sizes", nargs="*", default=SIZES, metavar="BATCH,LAYER,...")
    parser.add_argument("--n-envs", nargs="*", type=int, default=N_ENVS)
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    open_project()
    torch.set_num_threads(1)
    rates = environments(arguments.task, arguments.n_envs, arguments.steps, arguments.rounds)
    growth = updates_by_size(arguments.sizes, arguments.rounds)
    tables = f"{table_of_environments(rates)}\n\n{table_of_updates(growth)}"
    publish(tables, {"environments": rates, "updates": growth}, arguments.json)


def environments(
    task: str, numbers: Sequence[int], n_steps: int, rounds: int
) -> list[dict[str, Any]]:
    """Return steps per second for each way to run environments side by side."""
    kinds = [(n, vector) for n in numbers for vector in VECTORS if n > 1 or vector == VECTORS[0]]
    envs = {
        kind: make_train_env(RunConfig(task, n_envs=kind[0], vector=kind[1], seed=1))
        for kind in kinds
    }
    courses = {kind: stepping(env, n_steps) for kind, env in envs.items()} | {
        kind: partial(peer.do, n_steps) for kind, peer in envpools(task, numbers).items()
    }
    for course in courses.values():
        course()
    calls = {f"{n} {name}": partial(timed, course) for (n, name), course in courses.items()}
    turns = take_turns(calls, rounds)
    for env in envs.values():
        env.close()
    rows = []
    for (n, name), taken in zip(courses, turns.values(), strict=True):
        wall, cpu = np.array(taken).T
        first = np.array(turns[f"{n} {VECTORS[0]}"])[:, 0]
        rows.append(
            {
                "n_envs": n,
                "vector": name,
                "steps_per_second": n * n_steps / statistics.median(wall),
                "cpu_ms": 1e3 * statistics.median(cpu) / (n * n_steps),
                "faster_than_inprocess": relative(first, wall),
            }
        )
    return rows


def envpools(task: str, numbers: Sequence[int]) -> dict[tuple[int, str], Peer]:
    """Return EnvPool's environments, by their number and a name; none where it has none."""
    if not task.startswith("Fetch") or not peers_are_installed():
        return {}
    return {
        (n, f"envpool-{n_threads}"): Peer("envpool_steps.py", task, n, n_threads)
        for n in numbers
        for n_threads in sorted({1, min(n, n_cores())})
    }


def stepping(env: Any, n_steps: int) -> Callable[[], float]:
    """Return what takes this many steps of all environments; it returns its workers' seconds."""
    random = np.random.default_rng(1)
    processes = getattr(observed_layer(env).venv, "processes", ())
    workers = [psutil.Process(process.pid) for process in processes]
    env.reset()

    def seconds_of_workers() -> float:
        return sum(sum(worker.cpu_times()[:2]) for worker in workers)

    def take_steps() -> float:
        before = seconds_of_workers()
        for _ in range(n_steps):
            env.step(random.uniform(-1, 1, (env.num_envs, *env.action_space.shape)))
        return seconds_of_workers() - before

    return take_steps


def updates_by_size(sizes: Sequence[str], rounds: int) -> list[dict[str, Any]]:
    """Return ms per update and its arithmetic for each size."""
    entries = [entry for entry in updates.ENTRIES if entry.name in ROWS]
    steps = updates.recorded_steps(1000) if sizes else []
    rows = []
    for size in sizes:
        batch_size, *net_arch = map(int, size.split(","))
        results = updates.measure(entries, batch_size, tuple(net_arch), rounds, steps)
        row = {
            "batch_size": batch_size,
            "net_arch": net_arch,
            "gflop": updates.gflop(batch_size, net_arch),
        }
        rows.append(row | {name: results[name] for name in ROWS})
    return rows


def table_of_environments(rows: list[dict[str, Any]]) -> str:
    """Return steps per second as a table."""
    lines = [f"{'environments':24}{'steps/s':>10}{'times one':>12}{'CPU ms':>10}  in process: 1"]
    for row in rows:
        name, rate = f"{row['n_envs']} {row['vector']}", row["steps_per_second"]
        times, (low, high) = row["faster_than_inprocess"].values()
        lines.append(
            f"{name:24}{rate:10.0f}{rate / rows[0]['steps_per_second']:12.2f}{row['cpu_ms']:10.2f}"
            f"  {times:.2f} ({low:.2f} to {high:.2f})"
        )
    return "\n".join(lines)


def table_of_updates(rows: list[dict[str, Any]]) -> str:
    """Return ms per update as a table."""
    lines = [f"{'batch, layers':34}{'GFLOP':>8}" + "".join(f"{f'{n}, ms':>20}" for n in ROWS)]
    for row in rows:
        name = f"{row['batch_size']}, {row['net_arch']}"
        cells = "".join(f"{row[name]['ms']:20.2f}" for name in ROWS)
        lines.append(f"{name:34}{row['gflop']:8.3f}{cells}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
