"""Hindsight replay of 1M FetchPush transitions: our buffer beside Stable-Baselines3's.

Both hold the same steps of the same episodes. Prints a table and one JSON object with, per buffer,

* ``sample_<n>_ms``: time to draw n transitions as tensors (bars: 0.4 ms for 256, 2 ms for 2048),
  ``reward_<n>_ms``: the part of ``compute_reward``, for as many goals as are put in;
* ``add_ms``: time to store a step of all environments;
* ``bytes_per_transition``: of its arrays, and of the infos that it keeps (bar: 60 % of the peer's);
* ``resident_bytes_per_transition``: by how much a process of its own grows while it is filled;
* ``save_seconds``, ``load_seconds``, ``saved_bytes_per_transition``: of a checkpoint with hashes.

Times are medians, taken in the order A B B A within one run.

Run: python benchmarks/replay.py [--transitions N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.learning.replay import HindsightReplayBuffer
from scilab_rl.training import checkpoint
from scilab_rl.training.snapshot import capture, restore

N_ENVS = 8
EPISODE = 50  # steps of an episode of Fetch
BATCH_SIZES = (256, 2048)
N_DRAWS = 60  # per block
PEERS = {"ours": HindsightReplayBuffer, "stable-baselines3": HerReplayBuffer}
Results = dict[str, dict[str, float]]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    env = make_train_env(RunConfig("FetchPush-v4", n_envs=N_ENVS, seed=1))
    buffers = {name: make(cls, env, arguments.transitions) for name, cls in PEERS.items()}
    results: Results = {name: {} for name in PEERS}
    for name in PEERS:
        growth = alone(resident_growth, name, arguments.transitions)
        results[name]["resident_bytes_per_transition"] = growth / arguments.transitions
    fill(buffers, env, arguments.transitions // N_ENVS, results)
    for batch_size in BATCH_SIZES:
        time_sampling(buffers, batch_size, results)
    for name, buffer in buffers.items():
        results[name]["bytes_per_transition"] = n_bytes(buffer) / arguments.transitions
        results[name] |= time_saving(buffer, env, arguments.transitions)
    ratios = {
        key: value / results["stable-baselines3"][key] for key, value in results["ours"].items()
    }
    report = {
        "transitions": arguments.transitions,
        **results,
        "ours_per_peer": ratios,
        "load_average": os.getloadavg()[0],
    }
    text = json.dumps(report, indent=2)
    sys.stdout.write(f"{table(results, ratios)}\n\n{text}\n")
    if arguments.json:
        arguments.json.write_text(text + "\n", encoding="utf-8")


def make(cls: type, env: VecEnv, size: int) -> Any:
    """Build a buffer of this many transitions."""
    spaces = env.observation_space, env.action_space
    return cls(size, *spaces, env, device="cpu", n_envs=N_ENVS)


def episodes(env: VecEnv, n_steps: int) -> Iterator[tuple[Any, ...]]:
    """Yield arguments of ``add``: numbers of the right shapes, which nobody had to simulate."""
    random = np.random.default_rng(1)
    shapes: Any = {key: (N_ENVS, *entry.shape) for key, entry in env.observation_space.items()}  # type: ignore[attr-defined]

    def observe(goal: np.ndarray) -> dict[str, np.ndarray]:
        drawn = {key: random.normal(scale=0.1, size=shape) for key, shape in shapes.items()}
        return drawn | {"desired_goal": goal}

    for step in range(n_steps):
        if step % EPISODE == 0:
            goal = random.normal(scale=0.1, size=shapes["desired_goal"])
            now = observe(goal)
        over = step % EPISODE == EPISODE - 1
        after = observe(goal)
        actions = random.uniform(-1, 1, size=(N_ENVS, 4)).astype(np.float32)
        infos = [{"TimeLimit.truncated": over} for _ in range(N_ENVS)]
        yield now, after, actions, -np.ones(N_ENVS), np.full(N_ENVS, over), infos
        now = after


def fill(buffers: dict[str, Any], env: VecEnv, n_steps: int, results: Results) -> None:
    """Add the same steps to both."""
    times: dict[str, list[float]] = {name: [] for name in buffers}
    for step in episodes(env, n_steps):
        for name, buffer in buffers.items():
            times[name].append(timed(partial(buffer.add, *step)))
    for name, values in times.items():
        results[name]["add_ms"] = 1e3 * statistics.median(values)


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as process:
        return process.apply(function, arguments)


def resident_growth(name: str, n_transitions: int) -> int:
    """Return by how many bytes this process grows while a buffer is made and filled."""
    torch.set_num_threads(1)
    env = make_train_env(RunConfig("FetchPush-v4", n_envs=N_ENVS, seed=1))
    for _ in episodes(env, EPISODE):  # what only making the steps takes is not the buffer's
        pass
    process = psutil.Process()
    before = process.memory_info().rss
    buffer = make(PEERS[name], env, n_transitions)
    for step in episodes(env, n_transitions // N_ENVS):
        buffer.add(*step)
    return process.memory_info().rss - before


def time_sampling(buffers: dict[str, Any], batch_size: int, results: Results) -> None:
    """Time blocks of draws in the order A B B A."""
    times: dict[str, list[float]] = {name: [] for name in buffers}
    for _ in range(3):
        for name in (*buffers, *reversed(buffers)):
            buffer = buffers[name]
            times[name] += [timed(partial(buffer.sample, batch_size)) for _ in range(N_DRAWS)]
    n_new = batch_size * 4 // 5
    goals = np.random.default_rng(1).normal(size=(2, n_new, 3))
    judge = {
        "ours": lambda: buffers["ours"]._reward(*goals.astype(np.float32), [{}] * n_new),
        "stable-baselines3": lambda: buffers["stable-baselines3"].env.env_method(
            "compute_reward", *goals, [{} for _ in range(n_new)], indices=[0]
        ),
    }
    for name in buffers:
        results[name][f"sample_{batch_size}_ms"] = 1e3 * statistics.median(times[name])
        judged = [timed(judge[name]) for _ in range(N_DRAWS)]
        results[name][f"reward_{batch_size}_ms"] = 1e3 * statistics.median(judged)


def n_bytes(buffer: Any) -> int:
    """Count the bytes of all arrays, with the objects that they hold."""
    total = 0
    for value in vars(buffer).values():
        for entry in value.values() if isinstance(value, dict) else [value]:
            if isinstance(entry, np.ndarray):
                total += entry.nbytes
                total += entry.size * sys.getsizeof({}) if entry.dtype.hasobject else 0
    return total


def time_saving(buffer: Any, env: VecEnv, n_transitions: int) -> dict[str, float]:
    """Save and restore, with the hashes of a checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint"
        saving = timed(lambda: checkpoint.save(capture({"buffer": buffer}), path, step=1))
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        fresh = make(type(buffer), env, n_transitions)
        loading = timed(lambda: restore({"buffer": fresh}, checkpoint.load(path)))
    return {
        "save_seconds": saving,
        "load_seconds": loading,
        "saved_bytes_per_transition": size / n_transitions,
    }


def timed(function: Callable[[], Any]) -> float:
    """Return how long a call takes, in seconds."""
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def table(results: Results, ratios: dict[str, float]) -> str:
    """Return the results side by side."""
    lines = [f"{'':32}{'ours':>10}{'stable-baselines3':>20}{'ratio':>8}"]
    for key, ratio in ratios.items():
        ours, theirs = (results[name][key] for name in PEERS)
        lines.append(f"{key:32}{ours:10.3f}{theirs:20.3f}{ratio:8.2f}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
