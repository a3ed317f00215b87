"""Environment steps per second of runs that learn, ours beside those of others.

Everybody trains soft actor-critic on FetchReach-v4, one update per environment step, batches of
256, layers of [256, 256], hindsight with four relabeled transitions per original one (CleanRL has
none). A step counts with all that belongs to it: acting, simulating, storing, sampling, updating.
Our runs are whole runs with all their files, of which only the evaluation is taken off. They and
their peers, which are in a virtual environment of their own, take turns of some hundred steps in
the order A B B A.

Prints a table and one JSON object with, per row, ``steps_per_second``, and ``times``: how much
longer Stable-Baselines3 takes in the same turn, with ``interval``, 95 % of its bootstrap.

Run: python benchmarks/steps.py [--rounds N] [--steps N] [--only NAME ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from participants import Peer, Run, peers_are_installed
from turns import Seconds, publish, relative, take_turns, timed

PEER = "stable-baselines3"
BATCH_SIZE, NET_ARCH = 256, (256, 256)


class Entry(NamedTuple):
    """A row of the table: the script of a peer, or the overrides of a run."""

    name: str
    script: str | None = None
    overrides: tuple[str, ...] = ()


ENTRIES = (
    Entry(PEER, "sb3_sac.py"),
    Entry("sbx", "sbx_sac.py"),
    Entry("tianshou", "tianshou_sac.py"),
    Entry("cleanrl", "cleanrl_sac.py"),
    Entry("cleansac", overrides=("algorithm=cleansac",)),
    Entry("cleansac bfloat16", overrides=("algorithm=cleansac", "algorithm.precision=bfloat16")),
    Entry("jaxsac", overrides=("algorithm=jaxsac",)),
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=4, help="of two turns each; default 4")
    parser.add_argument("--steps", type=int, default=400, help="per turn; default 400")
    parser.add_argument("--only", nargs="*", choices=[entry.name for entry in ENTRIES])
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    entries = [entry for entry in ENTRIES if not arguments.only or entry.name in arguments.only]
    if not peers_are_installed():
        entries = [entry for entry in entries if entry.script is None]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as ends:
        turns = {
            entry.name: start(entry, arguments.steps, Path(folder) / str(index), ends)
            for index, entry in enumerate(entries)
        }
        for turn in turns.values():  # compiles, and takes the first random steps
            turn()
        times = take_turns(turns, arguments.rounds)
    rows = {name: compare(taken, times, arguments.steps) for name, taken in times.items()}
    publish(table(rows), rows, arguments.json)


def start(entry: Entry, n_steps: int, folder: Path, ends: ExitStack) -> Callable[[], Seconds]:
    """Start a participant, and return what lets it take its turn."""
    if entry.script is not None:
        peer = Peer(entry.script, "live", BATCH_SIZE, *NET_ARCH)
        return partial(timed, partial(peer.do, n_steps))
    run = Run(
        (
            *entry.overrides, "tuned=false", f"algorithm.batch_size={BATCH_SIZE}",
            f"algorithm.net_arch=[{','.join(map(str, NET_ARCH))}]", "n_test_rollouts=1",
            f"eval_after_n_steps={n_steps}", f"base_logdir={folder}",
        )
    )  # fmt: skip
    ends.callback(run.end)
    return run.epoch


def compare(taken: list[Seconds], times: dict[str, list[Seconds]], n_steps: int) -> dict[str, Any]:
    """Return a row."""
    row: dict[str, Any] = {"steps_per_second": n_steps / statistics.median(t.wall for t in taken)}
    if PEER in times:
        ratios = relative([t.wall for t in times[PEER]], [t.wall for t in taken])
        row |= {"times": ratios["ratio"], "interval": ratios["interval"]}
    return row


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the results as a table."""
    lines = [f"{'':26}{'steps/s':>9}{'times':>8}{'95 %':>15}"]
    for name, row in rows.items():
        low, high = row.get("interval", (float("nan"), float("nan")))
        lines.append(
            f"{name:26}{row['steps_per_second']:9.1f}{row.get('times', float('nan')):8.2f}"
            f"{f'{low:.2f} - {high:.2f}':>15}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
