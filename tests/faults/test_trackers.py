"""Tracking servers that are not there, die, hang or answer nonsense: training does not notice."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.results import RunResult
from scilab_rl.run.directory import RunDirectory, read_epochs
from scilab_rl.tracking.background import BackgroundTracker
from scilab_rl.tracking.base import TrackedRun, Tracker

from .environment import ID
from .harness import RANDOM, allows_namespaces, content, last_run, result_of, scilab_rl


class Server:
    """A server whose answers a test chooses while it runs: ok, error, hang, close."""

    def __init__(self) -> None:
        self.mode, self.n_requests = "ok", 0

    @contextmanager
    def running(self) -> Iterator[str]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                server.n_requests += 1
                if server.mode == "hang":
                    time.sleep(3)
                if server.mode == "close":
                    self.connection.close()
                    return
                self.send_response(500 if server.mode == "error" else 200)
                self.end_headers()

            def log_message(self, *arguments: Any) -> None:
                pass

        http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        http.daemon_threads = True
        threading.Thread(target=http.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{http.server_port}"
        finally:
            http.shutdown()
            http.server_close()


class Posting(Tracker):
    """Sends each epoch to a server and waits for its answer."""

    def __init__(self, address: str) -> None:
        self.address = address

    def epoch(self, step: int, epoch: int, values: Any) -> None:
        from urllib.request import urlopen

        with urlopen(self.address, data=b"x", timeout=1) as answer:
            answer.read()


def run_info(folder: Path) -> TrackedRun:
    return TrackedRun(RunConfig("Env", base_logdir=str(folder)), folder)


RESULT = RunResult("finished", 1.0, 1, 1, 1.0, "run")


@pytest.mark.parametrize("mode", ["error", "hang", "close", "gone"])
def test_f22_server_that_fails_in_the_middle_costs_no_time(
    mode: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    server = Server()
    with server.running() as address:
        mirror = BackgroundTracker(Posting(address), "stub", queue_size=50, patience_seconds=2)
        mirror.begin(run_info(tmp_path))
        mirror.epoch(1, 1, {})
        deadline = time.monotonic() + 10
        while not server.n_requests and time.monotonic() < deadline:
            time.sleep(0.01)
        assert server.n_requests == 1
        server.mode = mode
        if mode == "gone":
            mirror.tracker.address = "http://127.0.0.1:9"  # type: ignore[attr-defined]
        longest = 0.0
        for number in range(500):
            started = time.thread_time()
            mirror.epoch(number, number, {"x": 1.0})
            longest = max(longest, time.thread_time() - started)
        began = time.monotonic()
        mirror.end(RESULT)
        assert time.monotonic() - began < 6
    assert longest < 0.01
    assert [r.getMessage() for r in caplog.records if "switched off" in r.getMessage()] != []
    assert caplog.text.count("switched off") == 1


@contextmanager
def silent_listener() -> Iterator[int]:
    """Accept connections and never answer."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["closed", "silent"])
def test_f21_server_that_is_not_there(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("mlflow")
    plain = scilab_rl(*RANDOM, cwd=tmp_path)
    assert plain.code == 0
    expected = content(last_run(tmp_path))
    with silent_listener() as port:
        address = f"http://127.0.0.1:{9 if kind == 'closed' else port}"
        done = scilab_rl(*RANDOM, "mlflow=1", f"tracking.mlflow.tracking_uri={address}",
                         cwd=tmp_path)  # fmt: skip
    assert done.code == 0, done.errors
    assert done.errors.count("mlflow is switched off for this run") == 1
    assert "Traceback" not in done.errors
    assert content(last_run(tmp_path)) == expected


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # MLflow's own
def test_f21_what_a_server_has_missed_is_sent_later(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow")
    away = "tracking.mlflow.tracking_uri=http://127.0.0.1:9"
    trained = scilab_rl(*RANDOM, "mlflow=1", away, cwd=tmp_path)
    assert trained.code == 0, trained.errors
    assert "Send them later: scilab-rl sync RUN --to mlflow" in trained.errors
    run = last_run(tmp_path)
    still_away = scilab_rl("sync", "last", cwd=tmp_path)
    assert still_away.code == 1
    assert "the same command sends the rest" in still_away.error
    there = f"sqlite:///{tmp_path / 'there.db'}"
    for said in ("values and 0 files sent", "already complete"):
        done = scilab_rl("sync", "last", "--uri", there, cwd=tmp_path)
        assert done.code == 0, done.errors
        assert f"{run.name}: " in done.errors
        assert said in done.errors
    client = mlflow.MlflowClient(there)
    (found,) = client.search_runs([e.experiment_id for e in client.search_experiments()])
    assert found.info.run_name.endswith(f" {run.name}")
    assert found.info.status == "FINISHED"
    assert found.data.params["env"] == ID
    rows = read_epochs(RunDirectory(run))
    assert len(rows) == 3
    names = {name for row in rows for name in row} - {"kind", "epoch", "step"}
    for name in names:
        history = client.get_metric_history(found.info.run_id, name)
        assert [(m.step, m.value) for m in history] == [(row["step"], row[name]) for row in rows]


@pytest.mark.slow
@pytest.mark.skipif(not allows_namespaces(), reason="this machine forbids networks of one's own")
def test_f23_wandb_without_key_and_network_never_asks(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    home = tmp_path / "home"
    home.mkdir()
    done = scilab_rl(*RANDOM, "wandb=1", cwd=tmp_path, network=False,
                     variables={"HOME": str(home), "WANDB_API_KEY": ""})  # fmt: skip
    assert done.code == 0, done.errors
    assert "sync with: wandb sync" in done.errors
    assert result_of(last_run(tmp_path))["status"] == "finished"
    assert list(last_run(tmp_path).glob("wandb/offline-run-*"))


def test_f23_wandb_that_is_not_installed_is_told_before_anything_starts(tmp_path: Path) -> None:
    done = scilab_rl(*RANDOM, "wandb=1", cwd=tmp_path, hidden=("wandb",))
    assert done.code == 2
    assert 'pip install "scilab-rl[wandb]"' in done.error
    assert not (tmp_path / "data").exists()
