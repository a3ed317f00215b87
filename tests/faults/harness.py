"""Runs of the command line as processes of their own, on broken disks and without a network.

The processes are forked from a server that has imported everything once: a run of some hundred
steps then takes less than a second, so that it can be killed at many places.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import json
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scilab_rl.files import FAULT_VARIABLE
from scilab_rl.run.directory import all_runs, find_run

from .environment import ID

ENV = f"env={ID}"
# Three epochs of a hundred steps with small networks.
QUICK = (
    ENV, "n_epochs=3", "eval_after_n_steps=100", "n_test_rollouts=2", "seed=7", "mlflow=0",
    "tuned=false",
)  # fmt: skip
RANDOM = ("algorithm=random", *QUICK)
CLEANSAC = (
    "algorithm=cleansac", *QUICK, "algorithm.buffer_size=2000", "algorithm.batch_size=16",
    "algorithm.net_arch=[16]",
)  # fmt: skip
_CLONE_NEWNS, _CLONE_NEWUSER, _CLONE_NEWNET = 0x00020000, 0x10000000, 0x40000000

_server = multiprocessing.get_context("forkserver")
_server.set_forkserver_preload(
    ["scilab_rl.cli.main", "scilab_rl.run.run", "hydra", "stable_baselines3", "sb3_contrib",
     "scilab_rl.training.loop", "scilab_rl.recording.callback",
     "scilab_rl.algorithms.cleansac",
     "scilab_rl.run.provenance", "scilab_rl.envs.fingerprint", "rich.console",
     "scilab_rl.search.folders", "tests.faults.environment"]
)  # fmt: skip


@dataclass(frozen=True)
class Done:
    """A process that has ended.

    Attributes:
        code: Its exit code; negative: the signal that killed it.
        output: What it wrote to standard output.
        errors: What it wrote to standard error.
        seconds: How long it took.
    """

    code: int
    output: str
    errors: str
    seconds: float

    @property
    def error(self) -> str:
        """The one line that says what was wrong."""
        lines = [line for line in self.errors.splitlines() if line.startswith("error:")]
        assert len(lines) == 1, self.errors
        return lines[0]


@dataclass
class Process:
    """A command line that runs.

    Args:
        arguments: As typed.
        cwd: Its folder.
        fault: See `scilab_rl.files.fault_point`.
        file_limit: Most bytes of a file, after which writing fails.
        disk: Size of the disk that ``data`` is then, as ``mount`` wants it; ``read-only`` for one
            that cannot be written.
        network: Whether it has one.
        hidden: Packages that cannot be imported.
        variables: More of the environment.
    """

    arguments: tuple[str, ...]
    cwd: Path
    fault: str = ""
    file_limit: int | None = None
    disk: str = ""
    network: bool = True
    hidden: tuple[str, ...] = ()
    variables: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._started = time.monotonic()
        self._files = [self.cwd / f".{id(self)}.{name}" for name in ("out", "err")]
        for path in self._files:  # it may be killed before it has written anything
            path.touch(0o600)
        self._process = _server.Process(target=_main, args=(self.__dict__.copy(),))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def is_running(self) -> bool:
        return self._process.is_alive()

    def wait(self, timeout: float = 120) -> Done:
        self._process.join(timeout)
        if self._process.is_alive():
            self._process.kill()
            raise AssertionError(f"{self.arguments} did not end within {timeout} s: {self._read()}")
        assert self._process.exitcode is not None
        seconds = time.monotonic() - self._started
        done = Done(self._process.exitcode, *self._read(), seconds)
        for path in self._files:
            path.unlink()
        return done

    def _read(self) -> tuple[str, str]:
        output, errors = (path.read_text(errors="replace") for path in self._files)
        return output, errors


def scilab_rl(*arguments: str, cwd: Path, timeout: float = 120, **options: Any) -> Done:
    """Run a command line to its end."""
    return Process(arguments, cwd, **options).wait(timeout)


def _main(settings: dict[str, Any]) -> None:
    os.chdir(settings["cwd"])
    for descriptor, path in zip((1, 2), settings["_files"], strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), descriptor)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
    os.environ |= {"TERM": "dumb", FAULT_VARIABLE: settings["fault"], **settings["variables"]}
    if settings["disk"] or not settings["network"]:
        _enter_namespaces(settings["disk"], settings["network"])
    if settings["file_limit"] is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (settings["file_limit"],) * 2)
    for package in settings["hidden"]:
        _hide(package)
    from scilab_rl.cli.main import run_command_line

    sys.argv = ["scilab-rl", *settings["arguments"]]
    code = run_command_line(list(settings["arguments"]))
    sys.stdout.flush()
    sys.exit(code)


class _Hidden:
    """Makes a package look as if it were not installed."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.partition(".")[0] == self.package:
            raise ModuleNotFoundError(f"No module named '{self.package}'", name=self.package)


def _hide(package: str) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        del sys.modules[name]
    sys.meta_path.insert(0, _Hidden(package))  # type: ignore[arg-type]
    found = importlib.util.find_spec

    def find_spec(name: str, *rest: Any) -> Any:
        return None if name.partition(".")[0] == package else found(name, *rest)

    importlib.util.find_spec = find_spec


def _enter_namespaces(disk: str, network: bool) -> None:
    flags = _CLONE_NEWUSER | (_CLONE_NEWNS if disk else 0) | (0 if network else _CLONE_NEWNET)
    user, group = os.getuid(), os.getgid()
    if ctypes.CDLL(None, use_errno=True).unshare(flags) != 0:
        raise OSError(ctypes.get_errno(), "unshare")
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    if disk:
        size = "1m" if disk == "read-only" else disk
        mode = "ro" if disk == "read-only" else "rw"
        data = Path("data")
        data.mkdir(exist_ok=True)
        options = ["-t", "tmpfs", "-o", f"size={size},{mode}", "tmpfs", str(data)]
        subprocess.run(["mount", *options], check=True)


def allows_namespaces() -> bool:
    """Return whether an ordinary user may have disks and networks of his own here."""
    if not shutil.which("unshare"):
        return False
    return subprocess.run(["unshare", "-rmn", "true"], check=False).returncode == 0


def runs_in(folder: Path) -> list[Path]:
    return [run.path for run in all_runs(folder / "data")]


def last_run(folder: Path) -> Path:
    return find_run("last", folder / "data").path


def result_of(run: Path) -> dict[str, Any]:
    return json.loads((run / "result.json").read_text(encoding="utf-8"))


def content(run: Path) -> dict[str, Any]:
    """Return all that has to be equal in two runs: metrics without times, episodes, and tensors."""
    rows = (run / "metrics.csv").read_text(encoding="utf-8").splitlines()
    n_columns = sum(not name.startswith("time/") for name in rows[0].split(","))
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return {
        "rows": [",".join(row.split(",")[:n_columns]) for row in rows],
        "lines": [
            {key: value for key, value in line.items() if not key.startswith("time")}
            for line in lines
        ],
        "weights": _sha256(run / "rl_model_finished" / "tensors.safetensors"),
        "best": _sha256(run / "rl_model_best" / "tensors.safetensors"),
    }


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def wait_until(condition: Any, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.01)
