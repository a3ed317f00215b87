"""Studies on a database server: nothing but the server is common to their processes."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scilab_rl.cli.main import run_command_line
from scilab_rl.errors import ScilabRLError
from scilab_rl.search.runs import COMPLETE, LOST, RUNNING
from scilab_rl.search.storage import StudyStorage

from . import toy
from .test_study import searched, start

# Optuna leaves its connections to the end of the process; ours end with it too.
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*(psycopg.Connection|sqlalchemy).*:ResourceWarning"
)


@pytest.fixture(autouse=True)
def collected() -> Iterator[None]:
    yield
    gc.collect()


def find_program(name: str) -> str | None:
    found = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    return shutil.which(name) or (str(found[-1]) if found else None)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Server:
    """A database server in a folder of its own, on the loopback.

    Args:
        command: Starts it.
        port: Where it listens.
        stop_signal: Ends it without waiting for its clients.
        quiet: Options of the process.
    """

    def __init__(self, command: list[object], port: int, stop_signal: int, **quiet: Any) -> None:
        self.command, self.port, self.stop_signal, self.quiet = command, port, stop_signal, quiet
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(self.command, **self.quiet)
        wait_for_server(self.port)

    def stop(self) -> None:
        self.process.send_signal(self.stop_signal)
        self.process.wait(30)


@pytest.fixture(scope="module")
def postgres_server() -> Iterator[Server]:
    """PostgreSQL, which refuses to run as root."""
    pytest.importorskip("psycopg")
    if not (find_program("initdb") and find_program("postgres")):
        pytest.skip("PostgreSQL is not installed")
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    other = {"user": "postgres", "group": "postgres"} if os.geteuid() == 0 else {}
    if other:
        shutil.chown(folder, "postgres", "postgres")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder} | other
    subprocess.run(
        [find_program("initdb"), "-D", folder / "db", "-U", "tester", "-A", "trust"],
        check=True, **quiet,
    )  # fmt: skip
    port = free_port()
    words = [find_program("postgres"), "-D", folder / "db", "-h", "127.0.0.1", "-p", str(port)]
    server = Server([*words, "-k", folder], port, signal.SIGINT, **quiet)
    yield server
    server.stop()
    shutil.rmtree(folder)


@pytest.fixture
def postgres(postgres_server: Server) -> str:
    return f"postgresql://tester@127.0.0.1:{postgres_server.port}/postgres"


@pytest.fixture(scope="module")
def mariadb_server() -> Iterator[Server]:
    pytest.importorskip("pymysql")
    if not (shutil.which("mariadbd") and shutil.which("mariadb-install-db")):
        pytest.skip("MariaDB is not installed")
    folder = Path(tempfile.mkdtemp(prefix="maria-"))
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    user = ["--user=root"] if os.geteuid() == 0 else []
    subprocess.run(
        ["mariadb-install-db", "--no-defaults", f"--datadir={folder / 'db'}",
         "--auth-root-authentication-method=normal", *user],
        check=True, **quiet,
    )  # fmt: skip
    port = free_port()
    words = ["mariadbd", "--no-defaults", f"--datadir={folder / 'db'}", f"--port={port}"]
    words += ["--bind-address=127.0.0.1", f"--socket={folder / 'socket'}", *user]
    server = Server(words, port, signal.SIGTERM, **quiet)
    yield server
    server.stop()
    shutil.rmtree(folder)


@pytest.fixture
def mariadb(mariadb_server: Server) -> str:
    return f"mysql://root@127.0.0.1:{mariadb_server.port}/test"


def wait_for_server(port: int) -> None:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            time.sleep(0.5)  # it listens a little before it is ready
            return
        except OSError:
            time.sleep(0.1)
    raise TimeoutError(port)


def two_parents_share(url: str, folder: Path) -> None:
    """Two processes with folders of their own, as on two machines, spend one budget together."""
    folders = [folder / machine / "shared" for machine in "ab"]
    processes = [start(folder, 12, storage=url) for folder in folders]
    outputs = [process.communicate(timeout=90) for process in processes]
    assert [output for output, _ in outputs] == ["finished\n"] * 2, outputs
    runs = StudyStorage(folders[0], url).runs()
    assert [run.number for run in runs] == list(range(13))
    assert {run.state for run in runs} == {COMPLETE}
    assert len({(run.trial, run.repeat) for run in runs}) == 13
    assert len({run.owner for run in runs}) == 2


def killed_parent_is_noticed(url: str, folder: Path) -> None:
    """What a killed process leaves is taken over by one that shares only the server with it."""
    process = start(folder / "a" / "killed", 10, storage=url)
    watched = StudyStorage(folder / "b" / "killed", url)
    deadline = time.monotonic() + 60
    while not any(run.state == COMPLETE for run in watched.runs()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    with watched.locked():
        watched.recover_lost_runs()
        assert not [run for run in watched.runs() if run.state == LOST], "its process still lives"
    process.kill()
    process.communicate()
    study = toy.run(folder / "b" / "killed", storage=url, max_trials=10)
    assert len(searched(study)) == 10
    assert not [run for run in study.runs if run.state in (RUNNING, LOST)]


def test_stop_reaches_all_machines_and_any_machine_sees_the_study(
    postgres: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """Two machines train; a third, which has the database's address only, looks and stops them."""
    folders = [tmp_path / machine / "everywhere" for machine in "ab"]
    processes = [start(folder, 400, storage=postgres) for folder in folders]
    watched = StudyStorage(folders[0], postgres)
    deadline = time.monotonic() + 60
    while sum(run.state == COMPLETE for run in watched.transact(watched.runs)) < 6:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    third = tmp_path / "c"
    third.mkdir()
    monkeypatch.chdir(third)
    assert run_command_line(["study", "--storage", postgres]) == 0
    assert "everywhere" in capfd.readouterr().out.split()
    assert run_command_line(["study", "everywher", "--storage", postgres]) == 2
    assert "Did you mean 'everywhere'" in capfd.readouterr().err
    assert not list(third.rglob("everywher"))
    assert run_command_line(["study", "stop", "everywhere", "--storage", postgres]) == 0
    outputs = [process.communicate(timeout=60)[0] for process in processes]
    assert all("study stop" in output for output in outputs), outputs
    runs = watched.transact(watched.runs)
    assert not [run for run in runs if run.state in (RUNNING, LOST)]
    assert len(runs) < 400
    capfd.readouterr()
    assert run_command_line(["study", "everywhere"]) == 0  # the folder has the address by now
    shown = capfd.readouterr().out
    assert "best configuration: #" in shown
    assert "scp -r here:/runs runs/" in shown, "where the winner's files are"
    study = third / "data" / "studies" / "everywhere"
    assert {"report.html", "winner.yaml", "winner.json"} <= {p.name for p in study.iterdir()}


def test_two_parents_share_a_study_on_postgresql(postgres: str, tmp_path: Path) -> None:
    two_parents_share(postgres, tmp_path)


def test_killed_parent_is_noticed_on_postgresql(postgres: str, tmp_path: Path) -> None:
    killed_parent_is_noticed(postgres, tmp_path)


@pytest.mark.slow
def test_two_parents_share_a_study_on_mariadb(mariadb: str, tmp_path: Path) -> None:
    two_parents_share(mariadb, tmp_path)


@pytest.mark.slow
def test_killed_parent_is_noticed_on_mariadb(mariadb: str, tmp_path: Path) -> None:
    killed_parent_is_noticed(mariadb, tmp_path)


def restarts_delay_a_study(server: Server, url: str, folder: Path) -> None:
    """Two processes train while their server goes away twice; no run is lost or made twice."""
    folders = [folder / machine / "patient" for machine in "ab"]
    processes = [start(directory, 24, storage=url, pruner="none") for directory in folders]
    watched = StudyStorage(folders[0], url)
    for n_runs in (3, 12):
        deadline = time.monotonic() + 60
        while sum(run.state == COMPLETE for run in watched.transact(watched.runs)) < n_runs:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        server.stop()
        time.sleep(2)
        server.start()
    outputs = [process.communicate(timeout=120) for process in processes]
    assert [output for output, _ in outputs] == ["finished\n"] * 2, outputs
    for _, errors in outputs:
        assert errors.count("waiting for it") == errors.count("continues") >= 2, errors
        assert "Traceback" not in errors
    runs = watched.transact(watched.runs)
    assert [run.number for run in runs] == list(range(25))
    assert len({(run.trial, run.repeat) for run in runs}) == 25
    assert {run.state for run in runs} == {COMPLETE}
    assert {run.attempt for run in runs} == {0}, "a process took over a run that was not lost"
    assert len({run.owner for run in runs}) == 2


def test_restarts_delay_a_study_on_postgresql(
    postgres_server: Server, postgres: str, tmp_path: Path
) -> None:
    restarts_delay_a_study(postgres_server, postgres, tmp_path)


@pytest.mark.slow
def test_restarts_delay_a_study_on_mariadb(
    mariadb_server: Server, mariadb: str, tmp_path: Path
) -> None:
    restarts_delay_a_study(mariadb_server, mariadb, tmp_path)


def test_lost_connection_is_made_again(postgres: str, tmp_path: Path) -> None:
    import psycopg

    storage = StudyStorage(tmp_path / "one" / "study", postgres)
    other = StudyStorage(tmp_path / "two" / "study", postgres)
    storage.acquire_lease()
    with psycopg.connect(postgres, autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid() "
            "AND backend_type = 'client backend'"
        )
    with storage.locked():
        pass
    with other.locked():
        assert other._locks.is_alive(storage.owner)
    storage.release_lease()
    with other.locked():
        assert not other._locks.is_alive(storage.owner)


def test_server_that_is_not_there_is_said_without_the_password(tmp_path: Path) -> None:
    pytest.importorskip("psycopg")
    with pytest.raises(ScilabRLError, match=r"anna:\*\*\*@127.0.0.1:1/x cannot be opened"):
        StudyStorage(tmp_path / "study", "postgresql://anna:secret@127.0.0.1:1/x")
