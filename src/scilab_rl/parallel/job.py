"""One run on another machine: it communicates through files in a folder that both can see.

The folder holds what to train (``task.json``), what the run says (``messages.jsonl``, one message a
line) and what the study answers (``answers``, one letter for each evaluation). Each file has one
writer, so nothing has to be locked, and a line counts only when it is whole. The study touches
``../alive`` as long as it listens; a run whose study has gone ends at its next evaluation.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scilab_rl.files import write_json
from scilab_rl.parallel.worker import LAST_WORDS, Channel, Message, Task

TASK_FILE, MESSAGES, ANSWERS, ALIVE = "task.json", "messages.jsonl", "answers", "alive"
GO_ON, STOP = "g", "s"
_POLL_SECONDS = 0.1
_PATIENCE_SECONDS = 120.0  # how long a study may be silent before it counts as gone
_CLOCK_TOLERANCE_SECONDS = 600.0  # by how much the clocks of two machines may differ

TrainFunction = Callable[[Task, Channel], Message]


class FileChannel:
    """The run's end of the exchange.

    Args:
        folder: The folder of the run.
        patience: Seconds without a sign of the study until it counts as gone.

    Attributes:
        earlier: What an earlier start of the same job has said.
    """

    def __init__(self, folder: Path, patience: float = _PATIENCE_SECONDS) -> None:
        self.folder = folder
        self.patience = patience
        # A cluster may have ended this job and started it again: what it asked before its end
        # has an answer of its own, which may also still come.
        self.earlier, end = read_messages(folder, 0)
        with contextlib.suppress(FileNotFoundError):
            os.truncate(folder / MESSAGES, end)  # a line that its end has torn
        self._n_answers = sum(message.kind == "evaluated" for message in self.earlier)

    def send(self, message: Message) -> None:
        """Say something to the study."""
        line = json.dumps(dataclasses.asdict(message))
        with (self.folder / MESSAGES).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
            file.flush()
            os.fsync(file.fileno())

    def recv(self) -> bool:
        """Wait for the answer to an evaluation; False also when the study has gone."""
        sign, since = _last_sign(self.folder), time.monotonic()
        while time.monotonic() - since < self.patience:
            answers = _read(self.folder / ANSWERS)
            if len(answers) > self._n_answers:
                self._n_answers += 1
                return answers[self._n_answers - 1] == GO_ON
            if _last_sign(self.folder) != sign:
                sign, since = _last_sign(self.folder), time.monotonic()
            time.sleep(_POLL_SECONDS)
        return False


def write_task(folder: Path, task: Task, n_threads: int, function: TrainFunction) -> None:
    """Describe a run for `run`.

    Args:
        folder: The folder of the run; created here.
        task: What to train.
        n_threads: Threads for numerical libraries.
        function: What trains it, a function of a module.
    """
    folder.mkdir(parents=True)
    stored = {
        "task": dataclasses.asdict(task),
        "directory": str(Path.cwd()),
        "n_threads": n_threads,
        "function": [function.__module__, function.__qualname__],
    }
    write_json(folder / TASK_FILE, stored)


def run(folder: str) -> None:
    """Train what a folder describes; called by the scheduler on the machine that it has chosen.

    A cluster that has preempted the job calls it again: then the run continues from its newest
    checkpoint, if it has one.
    """
    here = Path(folder)
    if time.time() - _last_sign(here) > _CLOCK_TOLERANCE_SECONDS:
        return  # it has waited in a queue longer than its study lived
    stored = json.loads((here / TASK_FILE).read_text(encoding="utf-8"))
    os.chdir(stored["directory"])  # paths of the configuration are relative to it
    os.environ["OMP_NUM_THREADS"] = str(stored["n_threads"])
    module, name = stored["function"]
    function: TrainFunction = getattr(importlib.import_module(module), name)
    channel = FileChannel(here)
    given: dict[str, Any] = stored["task"] | {"overrides": tuple(stored["task"]["overrides"])}
    for message in channel.earlier:
        if message.kind in LAST_WORDS:
            return
        if message.kind == "started":
            given["run_dir"] = message.content["run_dir"]
    channel.send(function(Task(**given), channel))


def read_messages(folder: Path, start: int) -> tuple[list[Message], int]:
    """Return what a run has said since a position in its file, and the new position.

    Args:
        folder: The folder of the run.
        start: Bytes that have been read before.
    """
    try:
        with (folder / MESSAGES).open("rb") as file:
            file.seek(start)
            text = file.read()
    except FileNotFoundError:
        return [], start
    whole = text[: text.rfind(b"\n") + 1]
    messages = [Message(**json.loads(line)) for line in whole.splitlines()]
    return messages, start + len(whole)


def write_answer(folder: Path, go_on: bool) -> None:
    """Answer an evaluation."""
    with (folder / ANSWERS).open("a", encoding="ascii") as file:
        file.write(GO_ON if go_on else STOP)


def _last_sign(folder: Path) -> float:
    try:
        return (folder.parent / ALIVE).stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except FileNotFoundError:
        return ""
