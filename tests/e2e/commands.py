"""Running the command line as a user does: as a process, in a folder of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
TINY = "env=scilab_rl.testing:TinyReach-v0"
# A run of some seconds: three epochs, small networks.
QUICK = (
    "n_epochs=3",
    "eval_after_n_steps=100",
    "n_test_rollouts=2",
    "seed=7",
    "mlflow=0",
    "algorithm.buffer_size=2000",
    "algorithm.batch_size=32",
)


def scilab_rl(
    *arguments: str, cwd: Path, timeout: float = 120, **environment: str
) -> subprocess.CompletedProcess:
    """Run ``python src/main.py ARGUMENTS`` in a folder and return what it printed."""
    return subprocess.run(
        command(*arguments),
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout,
        env=quiet_environment(**environment),
        check=False,
    )


def command(*arguments: str) -> list[str]:
    return [sys.executable, str(ROOT / "src" / "main.py"), *arguments]


def quiet_environment(**more: str) -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1", "TERM": "dumb"} | more


def last_run(folder: Path) -> Path:
    return (folder / "data" / "last").resolve()


def config_of(run: Path) -> dict:
    return yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))


def untimed_rows(run: Path) -> list[str]:
    """Return the rows of metrics.csv without the time columns, which come last."""
    rows = (run / "metrics.csv").read_text(encoding="utf-8").splitlines()
    n_columns = sum(not name.startswith("time/") for name in rows[0].split(","))
    return [",".join(row.split(",")[:n_columns]) for row in rows]
