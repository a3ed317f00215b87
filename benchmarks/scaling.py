"""How speed changes with size: environments side by side, networks, batches.

* ``environments``: steps per second of FetchReach with random actions, for 1 to 8 environments in
  one process, in one per core and in a process each;
* ``updates``: ms per update of `cleansac` and `jaxsac` as width, depth and batch grow, beside the
  matrix products that SAC cannot do without (the row of that name in `updates.py`).

All that is compared takes turns in the order A B B A; reported are medians.

Prints a table per part and one JSON object.

Run: python benchmarks/scaling.py [--rounds N] [--steps N] [--sizes BATCH,LAYER,... ...]
[--n-envs N ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
import updates
from turns import publish, take_turns, timed

from scilab_rl.envs.vectorize import EnvSettings, make_train_env
from scilab_rl.workspace import open_desk

N_ENVS = (1, 2, 4, 8)
VECTORS = ("inprocess", "workers", "subprocess")
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
    parser.add_argument("--rounds", type=int, default=10, help="of two turns each; default 10")
    parser.add_argument("--steps", type=int, default=50, help="of all environments, per turn")
    parser.add_argument("--sizes", nargs="*", default=SIZES, metavar="BATCH,LAYER,...")
    parser.add_argument("--n-envs", nargs="*", type=int, default=N_ENVS)
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    open_desk()
    torch.set_num_threads(1)
    rates = environments(arguments.n_envs, arguments.steps, arguments.rounds)
    growth = updates_by_size(arguments.sizes, arguments.rounds)
    tables = f"{table_of_environments(rates)}\n\n{table_of_updates(growth)}"
    publish(tables, {"environments": rates, "updates": growth}, arguments.json)


def environments(numbers: Sequence[int], n_steps: int, rounds: int) -> list[dict[str, Any]]:
    """Return steps per second for each way to run environments side by side."""
    kinds = [(n, vector) for n in numbers for vector in VECTORS if n > 1 or vector == VECTORS[0]]
    envs = {
        f"{n} {vector}": make_train_env(EnvSettings("FetchReach-v4", n_envs=n, vector=vector))
        for n, vector in kinds
    }
    courses = {name: partial(timed, stepping(env, n_steps)) for name, env in envs.items()}
    for course in courses.values():
        course()
    times = take_turns(courses, rounds)
    for env in envs.values():
        env.close()
    return [
        {
            "n_envs": n,
            "vector": vector,
            "steps_per_second": n * n_steps / statistics.median(t.wall for t in taken),
        }
        for (n, vector), taken in zip(kinds, times.values(), strict=True)
    ]


def stepping(env: Any, n_steps: int) -> Callable[[], None]:
    """Return what takes this many steps of all environments."""
    random = np.random.default_rng(1)
    env.reset()

    def take_steps() -> None:
        for _ in range(n_steps):
            env.step(random.uniform(-1, 1, (env.num_envs, *env.action_space.shape)))

    return take_steps


def updates_by_size(sizes: Sequence[str], rounds: int) -> list[dict[str, Any]]:
    """Return ms per update and its arithmetic for each size."""
    entries = [entry for entry in updates.ENTRIES if entry.name in ROWS]
    steps = updates.recorded_steps(1000)
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
    lines = [f"{'environments':24}{'steps/s':>10}{'times one':>12}"]
    for row in rows:
        name, rate = f"{row['n_envs']} {row['vector']}", row["steps_per_second"]
        lines.append(f"{name:24}{rate:10.0f}{rate / rows[0]['steps_per_second']:12.2f}")
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
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        main()
