"""Updates per second of our algorithms beside Stable-Baselines3's, on the same data.

Every algorithm is built as a run would build it, gets the same recorded steps of FetchReach into a
replay buffer of 1M transitions, and does updates as a run does them: sampling with hindsight,
gradients, targets, and its own bookkeeping. Single updates of all algorithms take turns, forwards
and then backwards (A B B A), so that slow changes of the machine's load cancel. Reported are, per
algorithm and batch size,

* ``ms``: median of the time per update, and ``ratio``: how much longer the peer's takes;
* ``cpu_ms`` and ``cpu_ratio``: the same of the processor time, as its lower quartile, which the
  machine's other work disturbs less;
* ``gemm_ms``, ``gemm_share``, ``gflops``: time, share and speed of the matrix products (PyTorch
  only). If all else were free, ``limit`` would be the ``cpu_ratio``.

Prints a table and one JSON object. Run: python benchmarks/updates.py [--rounds N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import hydra
import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from scilab_rl import assembly, config
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.workspace import open_desk

PEER = "stable-baselines3"
SBX = "sbx"
PEERS_PYTHON = Path(__file__).parents[1] / ".venv-peers" / "bin" / "python"


class Entry(NamedTuple):
    """A row of the table: name, overrides of the configuration, and updates per round."""

    name: str
    overrides: tuple[str, ...]
    updates_per_call: int = 1


ENTRIES = (
    Entry(PEER, ("algorithm=sac", "algorithm.replay_buffer_class=her")),
    Entry(f"{PEER}, our buffer", ("algorithm=sac",)),
    Entry("cleansac", ("algorithm=cleansac",)),
    Entry("cleansac bfloat16", ("algorithm=cleansac", "algorithm.precision=bfloat16")),
    Entry(SBX, ()),
    Entry("jaxsac", ("algorithm=jaxsac",)),
    Entry("jaxsac, 8 in a round", ("algorithm=jaxsac",), 8),
    Entry("jaxsac bfloat16, 8 in a round", ("algorithm=jaxsac", "algorithm.precision=bfloat16"), 8),
    Entry("jaxtd3, 8 in a round", ("algorithm=jaxtd3",), 8),
)
# Batch size and hidden layers.
SIZES = ((256, (256, 256)), (2048, (512, 512, 512)))
N_STEPS = 5_000
EPISODE = 50
GEMM = ("aten::bmm", "aten::baddbmm", "aten::mm", "aten::addmm")
Results = dict[str, dict[str, float]]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40, help="of the smaller batch")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="names of rows")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    open_desk()
    entries = [entry for entry in ENTRIES if not arguments.only or entry.name in arguments.only]
    if not PEERS_PYTHON.exists():
        sys.stdout.write("Without sbx: `make .venv-peers/.installed` installs the peers.\n")
        entries = [entry for entry in entries if entry.name != SBX]
    report: dict[str, Any] = {"threads": arguments.threads}
    for batch_size, net_arch in SIZES:
        rounds = max(3, arguments.rounds * 256 // batch_size)
        results = measure(entries, batch_size, net_arch, rounds, arguments.threads)
        report[f"batch {batch_size}, {list(net_arch)}"] = results
        sys.stdout.write(f"{table(batch_size, net_arch, results)}\n\n")
        sys.stdout.flush()
    report["load_average"] = os.getloadavg()[0]
    text = json.dumps(report, indent=2)
    sys.stdout.write(text + "\n")
    if arguments.json:
        arguments.json.write_text(text + "\n", encoding="utf-8")


def measure(
    entries: list[Entry], batch_size: int, net_arch: tuple[int, ...], rounds: int, threads: int
) -> Results:
    """Let all algorithms take turns."""
    updates = {entry.name: prepare(entry, batch_size, net_arch, threads) for entry in entries}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in updates}
    for update in updates.values():
        update()
        update()
    for _ in range(rounds):
        for name in (*updates, *reversed(updates)):
            started = time.perf_counter(), time.process_time()
            elsewhere = updates[name]() or 0.0
            wall, cpu = time.perf_counter() - started[0], time.process_time() - started[1]
            times[name].append((wall, cpu + elsewhere))
    results: Results = {}
    for entry in entries:
        wall, cpu = 1e3 * np.array(times[entry.name]).T / entry.updates_per_call
        row = {"ms": float(np.median(wall)), "cpu_ms": float(np.quantile(cpu, 0.25))}
        row |= matrix_products(updates[entry.name], entry.updates_per_call)
        results[entry.name] = row
    for row in results.values() if PEER in results else ():
        row["ratio"] = results[PEER]["ms"] / row["ms"]
        row["cpu_ratio"] = results[PEER]["cpu_ms"] / row["cpu_ms"]
        if "gemm_ms" in row:
            row["limit"] = results[PEER]["cpu_ms"] / row["gemm_ms"]
    return results


def prepare(
    entry: Entry, batch_size: int, net_arch: tuple[int, ...], threads: int
) -> Callable[[], Any]:
    """Build an algorithm with data, and return what does its updates."""
    if entry.name == SBX:
        return peer_process("sbx_sac.py", batch_size, net_arch)
    layers = f"[{','.join(map(str, net_arch))}]"
    is_peer = entry.overrides[0] == "algorithm=sac"
    architecture = f"algorithm.policy_kwargs={{net_arch:{layers}}}" if is_peer else ""
    overrides = [*entry.overrides, architecture or f"algorithm.net_arch={layers}"]
    cfg = config.compose(
        [
            *overrides,
            f"algorithm.batch_size={batch_size}",
            "env=FetchReach",
            "seed=1",
            "tuned=false",
        ]
    )
    torch.set_num_threads(threads)
    env = make_train_env(assembly.env_settings(cfg))
    algorithm = assembly.make_algorithm(cfg, env)
    for step in recorded_steps(env):
        algorithm.replay_buffer.add(*step)
    if is_peer:
        from scilab_rl.metrics.logger import MetricLogger

        algorithm.set_logger(MetricLogger())
        return lambda: algorithm.train(entry.updates_per_call, batch_size)
    if not hasattr(algorithm, "rounds"):
        return lambda: algorithm.train(entry.updates_per_call)
    algorithm.gradient_steps = entry.updates_per_call

    def update_round() -> None:
        algorithm.rounds.start(algorithm.draw())
        algorithm.finish_round()

    return update_round


def peer_process(script: str, batch_size: int, net_arch: tuple[int, ...]) -> Callable[[], float]:
    """Start a peer in its own virtual environment, and return what makes it do one update.

    The function returns the seconds of processor time that the peer took.
    """
    command = [PEERS_PYTHON, Path(__file__).parent / "peers" / script, batch_size, *net_arch]
    process = subprocess.Popen(
        list(map(str, command)), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None and process.stdout is not None
    requests, answers = process.stdin, process.stdout
    answers.readline()  # it is ready

    def update() -> float:
        requests.write("update\n")
        requests.flush()
        return float(answers.readline())

    return update


def recorded_steps(env: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the same steps with random actions for everybody, as arguments of ``add``."""
    env.seed(1)
    random = np.random.default_rng(1)
    now = env.reset()
    for _ in range(N_STEPS):
        actions = random.uniform(-1, 1, size=(1, *env.action_space.shape)).astype(np.float32)
        after, rewards, dones, infos = env.step(actions)
        following = after
        if dones[0]:
            last = infos[0]["terminal_observation"]
            following = {key: entry[np.newaxis] for key, entry in last.items()}
        yield now, following, actions, rewards, dones, infos
        now = after


def matrix_products(update: Callable[[], Any], n_updates: int) -> dict[str, float]:
    """Return time, share and speed of PyTorch's matrix products, if there are any."""
    n_calls = 8
    with profile(activities=[ProfilerActivity.CPU], with_flops=True) as profiled:
        for _ in range(n_calls):
            update()
    durations: dict[tuple[str, str], list[float]] = {}
    flops = 0.0
    for event in profiled.events():
        key = (event.name, str(event.input_shapes))
        durations.setdefault(key, []).append(event.self_cpu_time_total)
        flops += event.flops or 0 if event.name in GEMM else 0

    def undisturbed(of: Callable[[str], bool]) -> float:
        """Count every event with the lower quartile of its kind, in ms per update."""
        kinds = [values for (name, _), values in durations.items() if of(name)]
        total = sum(float(np.quantile(values, 0.25)) * len(values) for values in kinds)
        return total / 1e3 / n_calls / n_updates

    gemm = undisturbed(lambda name: name in GEMM)
    if gemm == 0:
        return {}
    return {
        "gemm_ms": gemm,
        "gemm_share": gemm / undisturbed(lambda _: True),
        "gflops": flops / n_calls / n_updates / gemm / 1e6,
    }


def table(batch_size: int, net_arch: tuple[int, ...], results: Results) -> str:
    """Return one block of the table."""
    columns = ("ms", "ratio", "cpu_ms", "cpu_ratio", "gemm_ms", "gemm_share", "gflops", "limit")
    lines = [f"batch {batch_size}, {list(net_arch)}"]
    lines.append(f"{'':32}" + "".join(f"{column:>12}" for column in columns))
    for name, row in results.items():
        cells = (f"{row[column]:12.2f}" if column in row else f"{'':12}" for column in columns)
        lines.append(f"{name:32}" + "".join(cells))
    return "\n".join(lines)


if __name__ == "__main__":
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        main()
