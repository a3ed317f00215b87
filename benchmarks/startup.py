"""Seconds until something happens: until ``--help`` has ended, and until the first step is taken.

The commands are those that a user types, with the defaults of a run. The first step is noticed by a
wrapper around the environment, which then ends the process. Beside ours stands the shortest script
that does the same with Stable-Baselines3: imports, FetchReach, SAC with hindsight, `learn`. After
one untimed turn, which warms the disk, all take turns in the order A B B A.

Prints a table and one JSON object with medians and all times (bars: 1 s for ``--help``, 6 s to the
first step).

Run: python benchmarks/startup.py [--rounds N] [--json FILE]
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
from turns import publish, take_turns

HERE = Path(__file__).parent
MAIN = str(HERE.parent / "src" / "main.py")
FIRST_STEP = "the first step"
PEER = "stable-baselines3"
_WRAPPER = "wrappers=[{_target_: startup.EndAtFirstStep}]"
_PEER_SCRIPT = """
import gymnasium, gymnasium_robotics
from stable_baselines3 import SAC, HerReplayBuffer
from startup import EndAtFirstStep
gymnasium.register_envs(gymnasium_robotics)
env = EndAtFirstStep(gymnasium.make("FetchReach-v4"))
SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer).learn(1000)
"""
COMMANDS = {
    "--help": ([MAIN, "--help"], 1.0),
    "cleansac": ([MAIN, "algorithm=cleansac", "env=FetchReach-v4", _WRAPPER], 6.0),
    "jaxsac": ([MAIN, "algorithm=jaxsac", "env=FetchReach-v4", _WRAPPER], 6.0),
    PEER: (["-c", _PEER_SCRIPT], None),
}


class EndAtFirstStep(gymnasium.Wrapper):
    """Ends the process when the first step has been taken."""

    def step(self, action: Any) -> Any:
        """Take it, and tell."""
        self.env.step(action)
        os.write(1, f"{FIRST_STEP}\n".encode())
        os._exit(0)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3, help="of two turns each; default 3")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        starts = {name: partial(seconds_of, name, Path(folder)) for name in COMMANDS}
        for start in starts.values():
            start()
        times = take_turns(starts, arguments.rounds)
    rows = {
        name: {"seconds": statistics.median(values), "bar": COMMANDS[name][1], "times": values}
        for name, values in times.items()
    }
    publish(table(rows), rows, arguments.json)


def seconds_of(name: str, folder: Path) -> float:
    """Return how long a command takes to its end or to its first step."""
    words, _ = COMMANDS[name]
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(HERE)},
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - started
    if done.returncode or (name != "--help" and FIRST_STEP not in done.stdout):
        raise SystemExit(f"{name} has failed:\n{done.stdout}{done.stderr}")
    return seconds


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the results as a table."""
    lines = [f"{'':20}{'seconds':>10}{'lowest':>10}{'highest':>10}{'bar':>8}"]
    for name, row in rows.items():
        bar = "" if row["bar"] is None else f"{row['bar']:.0f}"
        low, high = min(row["times"]), max(row["times"])
        lines.append(f"{name:20}{row['seconds']:10.2f}{low:10.2f}{high:10.2f}{bar:>8}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
