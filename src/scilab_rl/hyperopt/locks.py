"""Locks that die with their process: who may decide about a study now, and who still works on it.

On one machine, or on a drive that all machines share, they are files. With a database server they
are the server's own advisory locks, so that the machines need nothing else in common.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Protocol

_DECISION = "decision"
_MYSQL_SECONDS = 3600  # MySQL wants a limit for waiting


class Locks(Protocol):
    """What a ledger asks for."""

    def exclusive(self) -> contextlib.AbstractContextManager[None]:
        """Keep all other processes out of this study for the moment of a decision."""

    def sign(self, owner: str) -> None:
        """Sign as alive; the signature is withdrawn when this process ends, however."""

    def withdraw(self) -> None:
        """Withdraw the signature."""

    def is_alive(self, owner: str) -> bool:
        """Tell whether the signature of another process is valid."""


class FileLocks:
    """Locked files.

    Args:
        folder: Folder for them; created when missing.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._signature: IO[str] | None = None

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        with (self.folder / "study.lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def sign(self, owner: str) -> None:
        """Sign as alive; the kernel withdraws the signature when this process ends, however."""
        self._signature = self._path(owner).open("w")
        fcntl.flock(self._signature, fcntl.LOCK_EX)

    def withdraw(self) -> None:
        """Withdraw the signature."""
        if self._signature is not None:
            Path(self._signature.name).unlink(missing_ok=True)
            self._signature.close()
            self._signature = None

    def is_alive(self, owner: str) -> bool:
        """Tell whether the signature of another process is valid."""
        try:
            with self._path(owner).open() as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        self._path(owner).unlink(missing_ok=True)
        return False

    def _path(self, owner: str) -> Path:
        return self.folder / f"{owner}.lease"


class ServerLocks:
    """Advisory locks of PostgreSQL, MySQL or MariaDB, which end with their connection.

    Args:
        engine: SQLAlchemy's engine for the server.
        study: Name of the study; studies do not wait for each other.
    """

    def __init__(self, engine: Any, study: str) -> None:
        self.engine = engine
        self.study = study
        self._is_mysql = engine.dialect.name in ("mysql", "mariadb")
        self._owner = ""
        # One connection for all: it is used every second, so the server does not drop it as idle.
        self._connection = self._connect()

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        import sqlalchemy

        try:
            self._lock(_DECISION)
        except sqlalchemy.exc.DBAPIError:  # the connection broke, and our locks with it
            self._connection = self._connect()
            self._lock(_DECISION)
            if self._owner:
                self._lock(self._owner)
        try:
            yield
        finally:
            self._release(_DECISION)

    def sign(self, owner: str) -> None:
        """Sign as alive; the server withdraws the signature when this process ends, however."""
        self._lock(owner)
        self._owner = owner

    def withdraw(self) -> None:
        """Withdraw the signature."""
        if self._owner:
            self._release(self._owner)
            self._owner = ""

    def is_alive(self, owner: str) -> bool:
        """Tell whether the signature of another process is valid."""
        if self._is_mysql:
            return not self._ask("SELECT IS_FREE_LOCK(:key)", owner)
        if not self._ask("SELECT pg_try_advisory_lock(:key)", owner):
            return True
        self._release(owner)
        return False

    def _connect(self) -> Any:
        connection = self.engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        connection.detach()  # it is ours alone, not one of the pool
        return connection

    def _lock(self, name: str) -> None:
        mysql = f"SELECT GET_LOCK(:key, {_MYSQL_SECONDS})"
        self._ask(mysql if self._is_mysql else "SELECT pg_advisory_lock(:key)", name)

    def _release(self, name: str) -> None:
        mysql = "SELECT RELEASE_LOCK(:key)"
        self._ask(mysql if self._is_mysql else "SELECT pg_advisory_unlock(:key)", name)

    def _ask(self, question: str, name: str) -> Any:
        import sqlalchemy

        digest = hashlib.sha256(f"{self.study}/{name}".encode()).digest()
        # PostgreSQL knows locks by a signed number of 64 bits, MySQL by at most 64 characters.
        key = (
            digest.hex()[:60] if self._is_mysql else int.from_bytes(digest[:8], "big", signed=True)
        )
        return self._connection.execute(sqlalchemy.text(question), {"key": key}).scalar()
