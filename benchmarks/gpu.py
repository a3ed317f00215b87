"""Environment steps per second of runs that learn, on the CPU and on a GPU.

`jaxsac`, `jaxtd3` and `cleansac` train on FetchReach-v4 with one update per step, with the default
batch and networks (256 and [256, 256]) and with large ones (2,048 and [512, 512, 512]). Each runs
with ``device=cpu`` and, where its library finds a GPU, with ``device=cuda``, in turns of some
hundred steps in the order A B B A. They are whole runs as in `steps.py`, without their evaluation.
On a GPU, the contract tests of these algorithms run too.

Prints a table and one JSON object with, per row, ``cpu`` and ``cuda`` in steps per second, and
``times``: how much longer the CPU takes in the same turn, with ``interval``, 95 % of its bootstrap;
and whether the contract tests pass.

Run: python benchmarks/gpu.py [--rounds N] [--steps N] [--only NAME ...]
[--sizes BATCH,LAYER,... ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from participants import Run
from turns import Seconds, publish, relative, take_turns

from scilab_rl.testing.algorithms import DEVICE_VARIABLE

ALGORITHMS = ("jaxsac", "jaxtd3", "cleansac")
SIZES = ("256,256,256", "2048,512,512,512")
ROOT = Path(__file__).parents[1]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3, help="of two turns each; default 3")
    parser.add_argument("--steps", type=int, default=400, help="per turn; default 400")
    parser.add_argument("--only", nargs="*", choices=ALGORITHMS, default=ALGORITHMS)
    parser.add_argument("--sizes", nargs="*", default=SIZES, metavar="BATCH,LAYER,...")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    on_gpu = [name for name in arguments.only if has_gpu(name)]
    if missing := [name for name in arguments.only if name not in on_gpu]:
        sys.stdout.write(f"There is no GPU for {', '.join(missing)}: only the CPU is measured.\n")
    rows = {}
    for algorithm in arguments.only:
        devices = ("cpu", "cuda") if algorithm in on_gpu else ("cpu",)
        for size in arguments.sizes:
            times = measure(algorithm, size, devices, arguments.rounds, arguments.steps)
            rows[f"{algorithm} {size}"] = compare(times, arguments.steps)
    contract = passes_contract_tests(on_gpu) if on_gpu else None
    publish(table(rows), {"rows": rows, "contract_tests_pass": contract}, arguments.json)


def has_gpu(algorithm: str) -> bool:
    """Return whether the library that an algorithm computes with has a GPU."""
    if not torch.cuda.is_available() or not algorithm.startswith("jax"):
        return torch.cuda.is_available()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # memory is for the runs
    import jax

    return jax.default_backend() == "gpu"


def measure(
    algorithm: str, size: str, devices: tuple[str, ...], rounds: int, n_steps: int
) -> dict[str, list[Seconds]]:
    """Return how long the turns of one run per device take."""
    batch_size, _, layers = size.partition(",")
    with tempfile.TemporaryDirectory() as folder, ExitStack() as ends:
        runs = {}
        for device in devices:
            overrides = (
                f"algorithm={algorithm}", "tuned=false", f"device={device}",
                f"algorithm.batch_size={batch_size}", f"algorithm.net_arch=[{layers}]",
                "n_test_rollouts=1", f"eval_after_n_steps={n_steps}", f"base_logdir={folder}",
            )  # fmt: skip
            runs[device] = Run(overrides)
            ends.callback(runs[device].end)
        for run in runs.values():  # compiles, and takes the first random steps
            run.epoch()
        return take_turns({device: run.epoch for device, run in runs.items()}, rounds)


def compare(times: dict[str, list[Seconds]], n_steps: int) -> dict[str, Any]:
    """Return a row."""
    wall = {device: [taken.wall for taken in turns] for device, turns in times.items()}
    row: dict[str, Any] = {d: n_steps / statistics.median(turns) for d, turns in wall.items()}
    if "cuda" in wall:
        ratios = relative(wall["cpu"], wall["cuda"])
        row |= {"times": ratios["ratio"], "interval": ratios["interval"]}
    return row


def passes_contract_tests(algorithms: list[str]) -> bool:
    """Run the contract tests of some algorithms on the GPU, and return whether all pass."""
    done = subprocess.run(
        [
            sys.executable, "-m", "pytest", "-q", "-n", "0", "tests/contract/test_algorithms.py",
            "-k", " or ".join(f"[{name}]" for name in algorithms),
        ],
        cwd=ROOT,
        env=os.environ | {DEVICE_VARIABLE: "cuda"},
        check=False,
    )  # fmt: skip
    return done.returncode == 0


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the results as a table."""
    lines = [f"{'steps/s':26}{'CPU':>9}{'GPU':>9}{'times':>8}{'95 %':>15}"]
    for name, row in rows.items():
        line = f"{name:26}{row['cpu']:9.1f}"
        if "cuda" in row:
            low, high = row["interval"]
            line += f"{row['cuda']:9.1f}{row['times']:8.2f}{f'{low:.2f} - {high:.2f}':>15}"
        lines.append(line)
    return "\n".join(lines)


if __name__ == "__main__":
    main()
