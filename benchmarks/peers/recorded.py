"""What the peers share: steps that were recorded for all, and work on request.

A peer is given a file of recorded steps, and does updates on them; or the word ``live``, and takes
steps of its own in FetchReach, with an update after each. It reads how many from standard input,
does them, and answers with the seconds of processor time that they took. What a library prints is
thrown away.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

HORIZON = 50  # steps of an episode of Fetch
LIVE = "live"


class Step(NamedTuple):
    """One step of FetchReach, whose episodes end only by running out of time."""

    now: dict[str, np.ndarray]
    following: dict[str, np.ndarray]
    action: np.ndarray
    reward: float
    over: bool


def read_steps(path: str) -> Iterator[Step]:
    """Yield the steps that `benchmarks/updates.py` has written."""
    with np.load(path) as file:
        arrays = dict(file)
    keys = [name.removeprefix("now/") for name in arrays if name.startswith("now/")]
    for index, action in enumerate(arrays["actions"]):
        now, following = (
            {key: arrays[f"{when}/{key}"][index] for key in keys} for when in ("now", "following")
        )
        reward, over = arrays["rewards"][index], arrays["dones"][index]
        yield Step(now, following, action, float(reward), bool(over))


def given() -> tuple[str | None, int, list[int]]:
    """Return the file of the steps if any, the batch size and the sizes of the hidden layers."""
    path, batch_size, *net_arch = sys.argv[1:]
    return None if path == LIVE else path, int(batch_size), list(map(int, net_arch))


class Requests:
    """Asked for work by the benchmark. To be made before anything can print."""

    def __init__(self) -> None:
        self._answers: TextIO = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
        sys.stdout = Path(os.devnull).open("w")
        self._started = 0.0

    def next(self) -> int:
        """Tell that the last work is done, and return how much comes next; 0: no more."""
        self._answers.write(f"{time.process_time() - self._started}\n")
        request = sys.stdin.readline()
        self._started = time.process_time()
        return int(request or 0)

    def serve(self, work: Callable[[int], object]) -> None:
        """Do as much as is asked for, until nobody asks any more."""
        while n := self.next():
            work(n)
