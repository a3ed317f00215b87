import os
import subprocess
import sys
import textwrap

import pytest

from scilab_rl.config.schema import AlgorithmConfig, RunConfig
from scilab_rl.results import RunResult
from scilab_rl.tracking.base import TrackedRun


def run_info(base, name="run", arguments=None, resumed_step=None, **facts):
    """A run as it is when trackers hear of it: its directory exists."""
    directory = base / "2026-01-02" / name
    directory.mkdir(parents=True, exist_ok=True)
    cfg = RunConfig(
        env="TinyReach-v0", seed=7, eval_after_n_steps=10, n_epochs=2, base_logdir=str(base),
        algorithm=AlgorithmConfig("sac", "stable_baselines3.SAC", arguments or {}), **facts,
    )  # fmt: skip
    return TrackedRun(cfg, directory, resumed_step)


def result(status="finished"):
    return RunResult(status, 0.5, 2, 20, 3.0, "a/run", {"eval/success_rate": 0.5})


@pytest.fixture
def in_a_process(tmp_path):
    """Start Python code in an empty folder with an empty home and without anything to answer."""
    home, folder = tmp_path / "home", tmp_path / "folder"
    home.mkdir()
    folder.mkdir()

    def start(code, *arguments, prefix=(), **environment):
        kept = {
            name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ
        }
        return subprocess.Popen(
            [
                *prefix,
                sys.executable,
                "-c",
                textwrap.dedent(code),
                *map(str, arguments),
            ],
            env=kept | {"HOME": str(home), "OMP_NUM_THREADS": "1"} | environment,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    start.home, start.folder = home, folder
    return start
