"""Updates per second of our algorithms beside those of others, on the same data.

Every algorithm is built as a run would build it, gets the same recorded steps of FetchReach into a
replay buffer of 1M transitions, and does updates as a run does them: sampling with hindsight,
gradients, targets, and its own bookkeeping. The others are Stable-Baselines3, sbx, Tianshou, and
CleanRL, which has no hindsight and only layers of [256, 256]; the last three answer from processes
in a virtual environment of their own. Single updates of all algorithms take turns, forwards
and then backwards (A B B A), so that slow changes of the machine's load cancel. Reported are, per
algorithm and batch size,

* ``ms``: median of the time per update; ``ratio``: how much longer Stable-Baselines3's takes, and
  ``sbx_ratio``: how much longer sbx's;
* ``cpu_ms`` and ``cpu_ratio``: the same of the processor time, as its lower quartile, which the
  machine's other work disturbs less;
* ``of_limit``: share of the arithmetic limit that is reached, in processor time. The limit is the
  row "matrix products": all that SAC with two critics cannot do without, in float32, in the sizes
  of the update, and nothing else. It takes its turn as the algorithms do. bfloat16 may exceed it;
* ``gemm_ms``, ``gemm_share``, ``gflops``: time, share and speed of the matrix products (PyTorch
  only). If all else were free, ``limit`` would be the ``cpu_ratio``.

Prints a table and one JSON object.
Run: python benchmarks/updates.py [--rounds N] [--sizes BATCH,LAYER,... ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from participants import Peer, peers_are_installed
from torch.profiler import ProfilerActivity, profile
from turns import publish, take_turns, timed

from scilab_rl.config.compose import compose
from scilab_rl.config.workspace import open_project
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.run.parts import make_algorithm

PEER = "stable-baselines3"
SBX = "sbx"
PRODUCTS = "matrix products"


class Entry(NamedTuple):
    """A row of the table.

    Attributes:
        name: What it is called.
        overrides: Of the configuration; none for what is not ours.
        updates_per_call: In one round.
        script: Of a peer in the other virtual environment.
        only_layers: The only ones that it has.
        has_limit: Whether the arithmetic limit is its own.
    """

    name: str
    overrides: tuple[str, ...] = ()
    updates_per_call: int = 1
    script: str | None = None
    only_layers: tuple[int, ...] | None = None
    has_limit: bool = True


ENTRIES = (
    Entry(PEER, ("algorithm=sac", "algorithm.replay_buffer_class=her")),
    Entry(f"{PEER}, our buffer", ("algorithm=sac",)),
    Entry("cleansac", ("algorithm=cleansac",)),
    Entry("cleansac bfloat16", ("algorithm=cleansac", "algorithm.precision=bfloat16")),
    Entry(SBX, script="sbx_sac.py"),
    Entry("tianshou", script="tianshou_sac.py"),
    # Two at a time, because its actor learns every second time.
    Entry("cleanrl", updates_per_call=2, script="cleanrl_sac.py", only_layers=(256, 256)),
    Entry("jaxsac", ("algorithm=jaxsac",)),
    Entry("jaxsac, 8 in a round", ("algorithm=jaxsac",), 8),
    Entry("jaxsac bfloat16, 8 in a round", ("algorithm=jaxsac", "algorithm.precision=bfloat16"), 8),
    Entry("jaxtd3, 8 in a round", ("algorithm=jaxtd3",), 8, has_limit=False),
    Entry(PRODUCTS),
)
# Batch size and hidden layers.
SIZES = ("256,256,256", "2048,512,512,512")
N_STEPS = 5_000
N_OBSERVATIONS, N_ACTIONS = 16, 4  # of FetchReach, goals included
GEMM = ("aten::bmm", "aten::baddbmm", "aten::mm", "aten::addmm")
Step = tuple[Any, ...]
Results = dict[str, dict[str, float]]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40, help="of a batch of 256; default 40")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="names of rows")
    parser.add_argument(
        "--sizes", nargs="*", default=SIZES, metavar="BATCH,LAYER,...", help="of the updates"
    )
    parser.add_argument("--steps", type=int, default=N_STEPS, help="recorded; default 5000")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    open_project()
    entries = [entry for entry in ENTRIES if not arguments.only or entry.name in arguments.only]
    if not peers_are_installed():
        entries = [entry for entry in entries if entry.script is None]
    torch.set_num_threads(arguments.threads)
    steps = recorded_steps(arguments.steps)
    report: dict[str, Any] = {"threads": arguments.threads}
    tables = []
    for size in arguments.sizes:
        batch_size, *net_arch = map(int, size.split(","))
        rounds = min(arguments.rounds, max(3, arguments.rounds * 256 // batch_size))
        results = measure(entries, batch_size, tuple(net_arch), rounds, steps)
        report[f"batch {batch_size}, {net_arch}"] = results
        tables.append(table(batch_size, net_arch, results))
    publish("\n\n".join(tables), report, arguments.json)


def measure(
    entries: Sequence[Entry],
    batch_size: int,
    net_arch: tuple[int, ...],
    rounds: int,
    steps: list[Step],
) -> Results:
    """Let all algorithms take turns."""
    entries = [entry for entry in entries if entry.only_layers in (None, net_arch)]
    updates = {entry.name: prepare(entry, batch_size, net_arch, steps) for entry in entries}
    for update in updates.values():  # compiles
        update()
        update()
    turns = {name: partial(timed, update) for name, update in updates.items()}
    times = take_turns(turns, rounds)
    results: Results = {}
    for entry in entries:
        wall, cpu = 1e3 * np.array(times[entry.name]).T / entry.updates_per_call
        row = {"ms": float(np.median(wall)), "cpu_ms": float(np.quantile(cpu, 0.25))}
        if entry.overrides and not entry.overrides[0].startswith("algorithm=jax"):
            row |= matrix_products(updates[entry.name], entry.updates_per_call)
        results[entry.name] = row
    compare(results, entries, gflop(batch_size, net_arch))
    return results


def compare(results: Results, entries: Sequence[Entry], work: float) -> None:
    """Add to each row what it is relative to the peers and to the limit."""
    if PRODUCTS in results:
        limit = results[PRODUCTS]
        limit["gflops"] = work / limit["cpu_ms"] * 1e3
        for entry in entries:
            if entry.has_limit:
                results[entry.name]["of_limit"] = limit["cpu_ms"] / results[entry.name]["cpu_ms"]
    for row in results.values() if SBX in results else ():
        row["sbx_ratio"] = results[SBX]["ms"] / row["ms"]
    for row in results.values() if PEER in results else ():
        row["ratio"] = results[PEER]["ms"] / row["ms"]
        row["cpu_ratio"] = results[PEER]["cpu_ms"] / row["cpu_ms"]
        if "gemm_ms" in row:
            row["limit"] = results[PEER]["cpu_ms"] / row["gemm_ms"]


def prepare(
    entry: Entry, batch_size: int, net_arch: tuple[int, ...], steps: list[Step]
) -> Callable[[], Any]:
    """Build an algorithm with data, and return what does its updates."""
    if entry.name == PRODUCTS:
        return all_products(batch_size, net_arch)
    if entry.script is not None:
        return peer_process(entry, batch_size, net_arch, steps)
    layers = f"[{','.join(map(str, net_arch))}]"
    is_peer = entry.overrides[0] == "algorithm=sac"
    architecture = f"algorithm.policy_kwargs={{net_arch:{layers}}}" if is_peer else ""
    overrides = [*entry.overrides, architecture or f"algorithm.net_arch={layers}"]
    cfg = configure(*overrides, f"algorithm.batch_size={batch_size}")
    algorithm = make_algorithm(cfg, make_train_env(cfg))
    for step in steps:
        algorithm.replay_buffer.add(*step)
    if is_peer:
        from scilab_rl.metrics.logger import MetricLogger

        algorithm.set_logger(MetricLogger())
        return lambda: algorithm.train(entry.updates_per_call, batch_size)
    return lambda: algorithm.train(entry.updates_per_call)


def configure(*overrides: str) -> Any:
    """Return the configuration of a run on FetchReach without anybody's tuned values."""
    return compose([*overrides, "env=FetchReach", "seed=1", "tuned=false"])


def peer_process(
    entry: Entry, batch_size: int, net_arch: tuple[int, ...], steps: list[Step]
) -> Callable[[], float]:
    """Start a peer, and return what makes it do its updates."""
    with written(steps) as path:
        words = (path, batch_size, *net_arch)
        peer = Peer(str(entry.script), *words, n_threads=torch.get_num_threads())
    return partial(peer.do, entry.updates_per_call)


@contextlib.contextmanager
def written(steps: list[Step]) -> Iterator[Path]:
    """Write steps to a file that exists for a while, without the dimension of environments."""
    now, following, actions, rewards, dones, _ = zip(*steps, strict=True)
    arrays = {"actions": actions, "rewards": rewards, "dones": dones}
    for when, observations in (("now", now), ("following", following)):
        for key in observations[0]:
            arrays[f"{when}/{key}"] = tuple(observation[key] for observation in observations)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "steps.npz"
        np.savez(path, **{name: np.concatenate(values) for name, values in arrays.items()})
        yield path


def recorded_steps(n: int) -> list[Step]:
    """Return the same steps with random actions for everybody, as arguments of ``add``."""
    return list(random_steps(make_train_env(configure()), n))


def random_steps(env: Any, n: int) -> Iterator[Step]:
    """Take steps with random actions."""
    env.seed(1)
    random = np.random.default_rng(1)
    now = env.reset()
    for _ in range(n):
        actions = random.uniform(-1, 1, size=(1, *env.action_space.shape)).astype(np.float32)
        after, rewards, dones, infos = env.step(actions)
        following = after
        if dones[0]:
            last = infos[0]["terminal_observation"]
            following = {key: entry[np.newaxis] for key, entry in last.items()}
        yield now, following, actions, rewards, dones, infos
        now = after


def products_of_sac(
    batch_size: int, net_arch: Sequence[int]
) -> list[tuple[int, tuple[int, int, int]]]:
    """Return how often an update multiplies which matrices.

    A layer is needed forwards, for the gradient of its weights, and for that of its inputs, which
    the first layer needs only where the gradient goes on: from the critics into the actions.

    Shapes:
        result: ``(count, (m, k, n))`` for products of ``(m, k)`` with ``(k, n)``.
    """
    actor = list(pairwise([N_OBSERVATIONS, *net_arch, 2 * N_ACTIONS]))
    critic = list(pairwise([N_OBSERVATIONS + N_ACTIONS, *net_arch, 1]))
    b = batch_size
    products: list[tuple[int, tuple[int, int, int]]] = []
    for n_in, n_out in actor:  # for the target and for the actor's loss
        products += [(2, (b, n_in, n_out)), (1, (n_in, b, n_out))]
    products += [(1, (b, n_out, n_in)) for n_in, n_out in actor[1:]]
    for n_in, n_out in critic:  # two, each in the target and in both losses
        products += [(6, (b, n_in, n_out)), (2, (n_in, b, n_out)), (2, (b, n_out, n_in))]
    products += [(2, (b, n_out, n_in)) for n_in, n_out in critic[1:]]
    return products


def gflop(batch_size: int, net_arch: Sequence[int]) -> float:
    """Return the arithmetic of an update.

    >>> round(gflop(256, [256, 256]), 3)
    0.575
    """
    products = products_of_sac(batch_size, net_arch)
    return sum(count * 2 * m * k * n for count, (m, k, n) in products) / 1e9


def all_products(batch_size: int, net_arch: Sequence[int]) -> Callable[[], None]:
    """Return what multiplies all matrices of an update, and does nothing else."""
    matrices = [
        (count, torch.randn(m, k), torch.randn(k, n), torch.empty(m, n))
        for count, (m, k, n) in products_of_sac(batch_size, net_arch)
    ]

    def multiply() -> None:
        for count, left, right, out in matrices:
            for _ in range(count):
                torch.mm(left, right, out=out)

    return multiply


def matrix_products(update: Callable[[], Any], n_updates: int) -> dict[str, float]:
    """Return time, share and speed of PyTorch's matrix products."""
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
    return {
        "gemm_ms": gemm,
        "gemm_share": gemm / undisturbed(lambda _: True),
        "gflops": flops / n_calls / n_updates / gemm / 1e6,
    }


def table(batch_size: int, net_arch: Sequence[int], results: Results) -> str:
    """Return one block of the table."""
    columns = (
        "ms", "ratio", "sbx_ratio", "cpu_ms", "cpu_ratio", "of_limit", "gemm_ms", "gemm_share",
        "gflops", "limit",
    )  # fmt: skip
    work = gflop(batch_size, net_arch)
    lines = [f"batch {batch_size}, {list(net_arch)}: {work:.3f} GFLOP per update of SAC"]
    lines.append(f"{'':32}" + "".join(f"{column:>12}" for column in columns))
    for name, row in results.items():
        cells = (f"{row[column]:12.2f}" if column in row else f"{'':12}" for column in columns)
        lines.append(f"{name:32}" + "".join(cells))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
