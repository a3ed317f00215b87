"""All benchmarks in their default sizes, one after the other: `make bench`.

Each prints its table, and its figures go to ``benchmarks/results/NAME.json``. One that fails does
not keep the others from running. Nothing else should run on the machine meanwhile.

Run: python benchmarks/all.py [--list] [NAME ...]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
RESULTS = HERE / "results"


class Benchmark(NamedTuple):
    """One command.

    Attributes:
        words: Script and arguments.
        about: What is measured, in a few words.
        minutes: Roughly how long it takes on two cores; what takes longer than an hour runs only
            when it is named.
        json: Arguments before the file of the figures.
    """

    words: tuple[str, ...]
    about: str
    minutes: int
    json: tuple[str, ...] = ("--json",)


BENCHMARKS = {
    "startup": Benchmark(("startup.py",), "--help and the first step", 2),
    "updates": Benchmark(("updates.py",), "updates per second beside the peers'", 6),
    "steps": Benchmark(("steps.py",), "steps per second beside the peers'", 8),
    "rounds": Benchmark(("rounds.py",), "how well a round of jaxsac overlaps", 1),
    "replay": Benchmark(("replay.py",), "hindsight replay: speed and memory", 1),
    "checkpoint": Benchmark(("checkpoint_1m.py",), "saving a replay buffer of 1M", 1),
    "environments": Benchmark(("environments.py",), "our environments beside the originals", 1),
    "scaling": Benchmark(("scaling.py",), "environments side by side, networks, batches", 2),
    "gpu": Benchmark(("gpu.py",), "steps per second on the CPU and on a GPU", 8),
    "cost": Benchmark(("cost.py",), "evaluation, tracking, metrics", 6),
    "showing": Benchmark(("showing.py",), "live view and recording", 5, ()),
    "study": Benchmark(("study.py",), "how busy a study keeps its workers", 4),
    "decisions": Benchmark(("decisions.py",), "what a study does next, with 10,000 runs", 3),
    "board": Benchmark(("board.py",), "the board of 1,000 runs: size, time to open", 1),
    "metrics": Benchmark(("load.py", "metrics"), "values recorded per second", 1),
    "exported": Benchmark(("exported_policies.py",), "policies for robots: exactness, time", 3),
    "hbayesdm": Benchmark(
        ("hbayesdm_data.py",), "people's choices: ours and hBayesDM's models", 50
    ),
    "reach": Benchmark(("time_to_success.py", "reach"), "time until FetchReach is mastered", 40),
    "push": Benchmark(("time_to_success.py", "push"), "time until FetchPush is mastered", 50),
    "pick": Benchmark(("time_to_success.py", "pick"), "FetchPickAndPlace in a fixed budget", 300),
    "slide": Benchmark(("time_to_success.py", "slide"), "FetchSlide in a fixed budget", 300),
}
HOUR = 60


def main() -> int:
    """Run what is wanted, and say what has failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all up to an hour")
    parser.add_argument("--list", action="store_true", help="only say what there is")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(BENCHMARKS):
        parser.error(f"there is no {', '.join(sorted(unknown))}; there is {', '.join(BENCHMARKS)}")
    if arguments.list:
        sys.stdout.writelines(
            f"{name:14}{benchmark.minutes:5} min  {benchmark.about}\n"
            for name, benchmark in BENCHMARKS.items()
        )
        return 0
    short = [name for name, benchmark in BENCHMARKS.items() if benchmark.minutes < HOUR]
    RESULTS.mkdir(exist_ok=True)
    failed = [name for name in arguments.names or short if not run(name)]
    sys.stdout.write(f"Failed: {', '.join(failed)}\n" if failed else f"Figures: {RESULTS}\n")
    return 1 if failed else 0


def run(name: str) -> bool:
    """Run one and return whether it ended well."""
    benchmark = BENCHMARKS[name]
    sys.stdout.write(f"\n=== {name}: {benchmark.about}, about {benchmark.minutes} min ===\n")
    sys.stdout.flush()
    script, *words = benchmark.words
    started = time.monotonic()
    done = subprocess.run(
        [sys.executable, HERE / script, *words, *benchmark.json, RESULTS / f"{name}.json"],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        check=False,
    )
    sys.stdout.write(f"--- {name}: {time.monotonic() - started:.0f} s\n")
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
