"""``scilab-rl mlflow``: the learning curves of all runs in a browser, by MLflow."""

from __future__ import annotations

import importlib.util
import logging
import signal
import subprocess
import sys
import time
import urllib.request
import webbrowser
from pathlib import Path

from scilab_rl import telemetry
from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.errors import ConfigError, MissingDependencyError

_log = logging.getLogger(__name__)
# MLflow opens on pages for language models; curves are in the charts of its other half.
_CHARTS = "workflowType=machine_learning&compareRunsMode=CHART"
_START_SECONDS = 180.0


def main(arguments: list[str]) -> int:
    """Run the command and return MLflow's exit code."""
    parser = CommandParser("mlflow", "Show the learning curves of all runs, by MLflow.")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"), help="default: data")
    parser.add_argument("--port", type=positive, default=5000, help="default: 5000")
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    options = parser.parse_args(arguments)
    if importlib.util.find_spec("mlflow") is None:
        raise MissingDependencyError("mlflow", "mlflow", "to browse runs")
    database = options.base_logdir.resolve() / "mlflow.db"
    if not database.is_file():
        raise ConfigError(f"There is no '{database}': train a run first, mlflow is on by default.")
    telemetry.switch_off()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the server must end with us
    words = ["--host", "127.0.0.1", "--port", str(options.port)]
    server = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "mlflow",
            "ui",
            *words,
            "--backend-store-uri",
            f"sqlite:///{database}",
        ]
    )
    try:
        address = chart_address(options.port, database)  # while the server starts
        if _is_ready(server, options.port):
            _log.info("Learning curves: %s (Ctrl-C ends it)", address)
            if not options.no_browser:
                webbrowser.open(address)
        return server.wait()
    finally:
        server.terminate()
        server.wait()


def chart_address(port: int, database: Path) -> str:
    """Return the address of the charts of the experiment that was changed last."""
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"sqlite:///{database}")
    found = client.search_experiments(order_by=["last_update_time DESC"])
    ours = [one for one in found if one.name != "Default"] or found
    return f"http://127.0.0.1:{port}/#/experiments/{ours[0].experiment_id}/runs?{_CHARTS}"


def _is_ready(server: subprocess.Popen[bytes], port: int) -> bool:
    """Wait until the server answers; False when it has ended or stays silent."""
    until = time.monotonic() + _START_SECONDS
    while server.poll() is None and time.monotonic() < until:
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=2).close()
            return True
        except OSError:
            time.sleep(0.2)
    return False
