"""MLflow's own page in a browser: what `make mlflow` opens shows learning curves."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from .chromium import EXECUTABLE, Chromium
from .commands import QUICK, TINY, quiet_environment, scilab_rl

pytestmark = pytest.mark.slow


def test_address_that_is_printed_shows_the_curves_of_a_run(tmp_path: Path) -> None:
    pytest.importorskip("mlflow")
    if EXECUTABLE is None or shutil.which("chromium") is None:
        pytest.skip("Chromium is not installed")
    words = [word for word in QUICK if not word.startswith("mlflow=")]
    trained = scilab_rl(TINY, "algorithm=sac", *words, "require_updates=false", cwd=tmp_path)
    assert trained.returncode == 0, trained.stderr
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    environment = {k: v for k, v in quiet_environment().items() if "TRACK" not in k}
    process = subprocess.Popen(
        [sys.executable, "-m", "scilab_rl.cli.main", "mlflow", "--port", str(port), "--no-browser"],
        cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=environment,
    )  # fmt: skip
    try:
        assert process.stderr is not None
        line = next(line for line in process.stderr if "Learning curves: " in line)
        address = re.findall(r"http://127\.0\.0\.1:\S+", line)[0]
        for server in psutil.Process(process.pid).children():
            assert server.environ()["MLFLOW_DISABLE_TELEMETRY"] == "true"
            assert server.environ()["DO_NOT_TRACK"] == "true"
        with Chromium() as page:
            page.open(address)
            page.wait_for("document.body.innerText.includes('eval/success_rate')", 60)
            assert page.evaluate("document.body.innerText.includes('sac s7 ')")
            if folder := os.environ.get("SCREENSHOTS"):
                page.screenshot(Path(folder) / "mlflow.png")
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)


def test_without_runs_it_says_what_to_do(tmp_path: Path) -> None:
    pytest.importorskip("mlflow")
    done = scilab_rl("mlflow", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "train a run first" in done.stderr
