"""Locks that die with their process: who may decide about a study now, and who still works on it.

On one machine, or on a drive that all machines share, they are files. With a database server they
are the server's own advisory locks, so that the machines need nothing else in common.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

from scilab_rl import files

if TYPE_CHECKING:
    import sqlalchemy

_DECISION = "decision"
_MYSQL_SECONDS = 3600  # MySQL requires a limit for waiting


class FileLocks:
    """Locked files.

    Args:
        folder: Folder for them; created when missing.

    Attributes:
        restored: Monotonic time, in seconds, at which the locks were last taken again after they
            had been dropped; files never are.
    """

    restored = -math.inf

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._lease: IO[str] | None = None

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        with (self.folder / "study.lock").open("w") as file:
            files.lock(file)
            yield

    def acquire_lease(self, owner: str) -> None:
        """Show that this process is alive; the kernel ends the lease with the process."""
        self._lease = self._path(owner).open("w")
        files.lock(self._lease)

    def release_lease(self) -> None:
        """End the lease."""
        if self._lease is not None:
            Path(self._lease.name).unlink(missing_ok=True)
            self._lease.close()
            self._lease = None

    def is_alive(self, owner: str) -> bool:
        """Return whether another process holds its lease."""
        with contextlib.suppress(FileNotFoundError), self._path(owner).open() as file:
            if not files.lock(file, wait=False):
                return True
            self._path(owner).unlink(missing_ok=True)
        return False

    def _path(self, owner: str) -> Path:
        return self.folder / f"{owner}.lease"


class ServerLocks:
    """Advisory locks of PostgreSQL, MySQL or MariaDB, which end with their connection.

    What is written through the same connection is written only while the locks are held.

    Args:
        engine: SQLAlchemy's engine for the server.
        study: Name of the study; studies do not wait for each other.

    Attributes:
        connection: The connection, in autocommit mode.
        restored: As in `FileLocks`; a server drops all locks when it stops.
    """

    def __init__(self, engine: sqlalchemy.Engine, study: str) -> None:
        self.engine = engine
        self.study = study
        self.restored = -math.inf
        self._is_mysql = engine.dialect.name in ("mysql", "mariadb")
        self._owner = ""
        # One connection for all: it is used every second, so the server does not drop it as idle.
        self.connection = self._connect()

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        import sqlalchemy

        try:
            self._lock(_DECISION)
        except sqlalchemy.exc.SQLAlchemyError:  # the connection broke, and our locks with it
            self._restore()
        try:
            yield
        finally:
            self._release(_DECISION)

    def acquire_lease(self, owner: str) -> None:
        """Show that this process is alive; the server ends the lease with the connection."""
        self._lock(owner)
        self._owner = owner

    def release_lease(self) -> None:
        """End the lease."""
        if self._owner:
            self._release(self._owner)
            self._owner = ""

    def is_alive(self, owner: str) -> bool:
        """Return whether another process holds its lease."""
        if self._is_mysql:
            return not self._ask("SELECT IS_FREE_LOCK(:key)", owner)
        if not self._ask("SELECT pg_try_advisory_lock(:key)", owner):
            return True
        self._release(owner)
        return False

    def _connect(self) -> sqlalchemy.Connection:
        connection = self.engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        connection.detach()  # it is ours alone, not one of the pool
        return connection

    def _restore(self) -> None:
        """Connect again and take the locks that ended with the broken connection."""
        self.connection.invalidate()
        self.connection = self._connect()
        self._lock(_DECISION)
        if self._owner:
            self._lock(self._owner)
        self.restored = time.monotonic()

    def _lock(self, name: str) -> None:
        mysql = f"SELECT GET_LOCK(:key, {_MYSQL_SECONDS})"
        self._ask(mysql if self._is_mysql else "SELECT pg_advisory_lock(:key)", name)

    def _release(self, name: str) -> None:
        import sqlalchemy

        mysql = "SELECT RELEASE_LOCK(:key)"
        with contextlib.suppress(sqlalchemy.exc.SQLAlchemyError):  # a broken one holds nothing
            self._ask(mysql if self._is_mysql else "SELECT pg_advisory_unlock(:key)", name)

    def _ask(self, question: str, name: str) -> object:
        import sqlalchemy

        digest = hashlib.sha256(f"{self.study}/{name}".encode()).digest()
        # PostgreSQL knows locks by a signed number of 64 bits, MySQL by at most 64 characters.
        key = (
            digest.hex()[:60] if self._is_mysql else int.from_bytes(digest[:8], "big", signed=True)
        )
        return self.connection.execute(sqlalchemy.text(question), {"key": key}).scalar()


Locks = FileLocks | ServerLocks
