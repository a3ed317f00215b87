"""A worker without torch: it follows the protocol of `worker.main` and draws its results."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path
from typing import Any

from scilab_rl.parallel.worker import Message, Task, _die_with_parent


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
    """Return a run whose result is drawn around ``mean`` by its seed; or break as asked."""
    given = dict(word.partition("=")[::2] for word in task.overrides)
    seed = int(given["seed"])
    connection.send(Message("started", {"run_dir": given["folder"]}))
    with Path(given["folder"], "trained.txt").open("a", encoding="utf-8") as file:
        file.write(f"{seed}\n")
    if "slow_seed" in given and seed == int(given["slow_seed"]):
        time.sleep(1.0)
    if "die_once" in given:
        try:
            Path(given["die_once"]).touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
        except FileExistsError:
            pass
    if "error" in given:
        return Message("failed", {"error": given["error"], "machine": False})
    values = []
    for epoch in range(1, 4):
        value = float(given["mean"]) + random.Random(seed).uniform(-1, 1) * float(given["noise"])
        values.append(value * epoch / 3)
        content = {"epoch": epoch, "step": epoch * 100, "value": values[-1]}
        connection.send(Message("evaluated", content))
        if not connection.recv():
            break
    content = {
        "status": "finished",
        "final": values[-1] if task.n_final_episodes else None,
        "run_dir": given["folder"],
        "seconds": 1.0,
        "steps": [100 * (i + 1) for i in range(len(values))],
        "values": values,
    }
    return Message("finished", content)
