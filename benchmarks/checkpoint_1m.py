"""Time and memory of a checkpoint with a full replay buffer of 1M FetchPush transitions.

Run: python benchmarks/checkpoint_1m.py [--transitions N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from stable_baselines3 import SAC, HerReplayBuffer

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.training import checkpoint
from scilab_rl.training.snapshot import capture, restore


def main() -> None:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    n = arguments.transitions
    process = psutil.Process()
    model = make_model(n)
    for array in arrays_of(model.replay_buffer):
        array[...] = 1  # touch every page, as a full buffer has
    model.replay_buffer.full = True
    before = process.memory_info().rss
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint"
        saving = timed(lambda: checkpoint.save(capture({"algorithm": model}), path, step=n))
        peak = process.memory_info().rss
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        fresh = make_model(n)
        loading = timed(lambda: restore({"algorithm": fresh}, checkpoint.load(path)))
    result = {
        "transitions": n,
        "save_seconds": round(saving, 2),
        "load_seconds": round(loading, 2),
        "bytes_per_transition": round(size / n),
        "memory_growth_while_saving_mib": round((peak - before) / 2**20, 1),
    }
    text = json.dumps(result, indent=2) + "\n"
    sys.stdout.write(text)
    if arguments.json:
        arguments.json.write_text(text, encoding="utf-8")


def make_model(n: int) -> SAC:
    """Build SAC with hindsight replay on FetchPush."""
    env = make_train_env(RunConfig("FetchPush-v4", seed=1))
    return SAC("MultiInputPolicy", env, buffer_size=n, replay_buffer_class=HerReplayBuffer)


def arrays_of(buffer: object) -> list:
    """Return the numeric arrays of a buffer."""
    arrays = []
    for value in vars(buffer).values():
        values = value.values() if isinstance(value, dict) else [value]
        arrays += [v for v in values if isinstance(v, np.ndarray) and not v.dtype.hasobject]
    return arrays


def timed(function: object) -> float:
    """Return how long a call takes, in seconds."""
    started = time.monotonic()
    function()  # type: ignore[operator]
    return time.monotonic() - started


if __name__ == "__main__":
    main()
