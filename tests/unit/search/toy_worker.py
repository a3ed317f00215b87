"""A worker without torch: it follows the protocol of `worker.main` and computes its evaluations."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import time
from pathlib import Path
from typing import Any

from scilab_rl.parallel.worker import Message, Task, _die_with_parent

N_EPOCHS, EPOCH_STEPS = 4, 100


def main(connection: Any, log_path: str, n_threads: int) -> None:
    """Follow the protocol of `worker.main`."""
    _die_with_parent()
    os.setsid()
    connection.send(Message("ready"))
    try:
        while (task := connection.recv()) is not None:
            connection.send(train(task, connection))
    except (EOFError, OSError):
        return


def train(task: Task, connection: Any) -> Message:
    """The same as `worker.train`, with faults where the overrides ask for them."""
    given = {k.lstrip("+"): v for k, _, v in (o.partition("=") for o in task.overrides)}
    x, rng = float(given["x"]), random.Random(int(given["seed"]))
    content = {"run_dir": f"runs/{given['x']}", "continues": task.run_dir, "place": "here:/runs"}
    connection.send(Message("started", content))
    _break(given, connection)
    if "error" in given:
        return Message("failed", {"error": given["error"], "machine": False})
    if "nan" in given:
        return Message("finished", _result([float("nan")] * N_EPOCHS, "finished", time.monotonic()))
    values: list[float] = []
    started = time.monotonic()
    for epoch in range(1, N_EPOCHS + 1):
        time.sleep(float(given.get("seconds", "0")) / N_EPOCHS)
        values.append((1 - (x - 0.7) ** 2) * epoch / N_EPOCHS + rng.gauss(0, 0.05))
        content = {"epoch": epoch, "step": epoch * EPOCH_STEPS, "value": values[-1]}
        connection.send(Message("evaluated", content))
        if not connection.recv():
            return Message("finished", _result(values, "pruned", started))
    return Message("finished", _result(values, "finished", started))


def train_on_ray(task: Task, channel: Any) -> Message:
    """The same, and note on which node."""
    import ray

    (channel.folder / "node").write_text(ray.get_runtime_context().get_node_id())
    return train(task, channel)


def _break(given: dict[str, str], connection: Any) -> None:
    """Die as asked: always, or only when nobody has done so before (``once=FILE``)."""
    if "die" not in given or float(given["x"]) != float(given.get("where", given["x"])):
        return
    if "once" in given:
        try:
            with Path(given["once"]).open("x") as file:
                file.write(str(os.getpid()))
        except FileExistsError:
            return
    if given["die"] == "segfault":
        ctypes.string_at(0)
    if given["die"] == "hang":
        time.sleep(60)
    if given["die"] == "exit":
        os._exit(3)
    os.kill(os.getpid(), signal.SIGKILL)


def _result(values: list[float], status: str, started: float) -> dict[str, Any]:
    return {
        "status": status,
        "run_dir": "runs/toy",
        "seconds": time.monotonic() - started,
        "steps": [EPOCH_STEPS * (i + 1) for i in range(len(values))],
        "values": values,
    }
