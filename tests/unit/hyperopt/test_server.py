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

import pytest

from scilab_rl.errors import ScilabRLError
from scilab_rl.hyperopt.ledger import Ledger
from scilab_rl.hyperopt.runs import COMPLETE, LOST, RUNNING

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


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    """A server in a folder of its own, on the loopback; PostgreSQL refuses to run as root."""
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
    server = subprocess.Popen(
        [find_program("postgres"), "-D", folder / "db", "-h", "127.0.0.1", "-p", str(port),
         "-k", folder],
        **quiet,
    )  # fmt: skip
    url = f"postgresql://tester@127.0.0.1:{port}/postgres"
    wait_for_server(url)
    yield url
    server.send_signal(signal.SIGINT)  # the fast way, which does not wait for clients
    server.wait(20)
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def mariadb() -> Iterator[str]:
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
    server = subprocess.Popen(
        ["mariadbd", "--no-defaults", f"--datadir={folder / 'db'}", f"--port={port}",
         "--bind-address=127.0.0.1", f"--socket={folder / 'socket'}", *user],
        **quiet,
    )  # fmt: skip
    url = f"mysql://root@127.0.0.1:{port}/test"
    wait_for_server(url)
    yield url
    server.terminate()
    server.wait(30)
    shutil.rmtree(folder)


def wait_for_server(url: str) -> None:
    port = int(url.rpartition(":")[2].partition("/")[0])
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            time.sleep(0.5)  # it listens a little before it is ready
            return
        except OSError:
            time.sleep(0.1)
    raise TimeoutError(url)


def two_parents_share(url: str, folder: Path) -> None:
    """Two processes with folders of their own, as on two machines, spend one budget together."""
    folders = [folder / machine / "shared" for machine in "ab"]
    processes = [start(folder, 12, storage=url) for folder in folders]
    outputs = [process.communicate(timeout=90) for process in processes]
    assert [output for output, _ in outputs] == ["finished\n"] * 2, outputs
    runs = Ledger(folders[0], url).runs()
    assert [run.number for run in runs] == list(range(13))
    assert {run.state for run in runs} == {COMPLETE}
    assert len({(run.trial, run.repeat) for run in runs}) == 13
    assert len({run.owner for run in runs}) == 2


def killed_parent_is_noticed(url: str, folder: Path) -> None:
    """What a killed process leaves is taken over by one that shares only the server with it."""
    process = start(folder / "a" / "killed", 10, storage=url)
    watched = Ledger(folder / "b" / "killed", url)
    deadline = time.monotonic() + 60
    while not any(run.state == COMPLETE for run in watched.runs()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    before = watched.runs()
    with watched.locked():
        assert watched.recover_lost_runs(before) == before, "its process still lives"
    process.kill()
    process.communicate()
    study = toy.run(folder / "b" / "killed", storage=url, max_trials=10)
    assert len(searched(study)) == 10
    assert not [run for run in study.runs if run.state in (RUNNING, LOST)]


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


def test_lost_connection_is_made_again(postgres: str, tmp_path: Path) -> None:
    import psycopg

    ledger = Ledger(tmp_path / "one" / "study", postgres)
    other = Ledger(tmp_path / "two" / "study", postgres)
    ledger.sign()
    with psycopg.connect(postgres, autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid() "
            "AND backend_type = 'client backend'"
        )
    with ledger.locked():
        pass
    with other.locked():
        assert other._locks.is_alive(ledger.owner)
    ledger.withdraw()
    with other.locked():
        assert not other._locks.is_alive(ledger.owner)


def test_server_that_is_not_there_is_said_without_the_password(tmp_path: Path) -> None:
    pytest.importorskip("psycopg")
    with pytest.raises(ScilabRLError, match=r"anna:\*\*\*@127.0.0.1:1/x cannot be opened"):
        Ledger(tmp_path / "study", "postgresql://anna:secret@127.0.0.1:1/x")
