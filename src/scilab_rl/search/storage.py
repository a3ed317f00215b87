"""Where a study keeps what it knows: one database, and locks that die with their process.

Every decision is made from the database under one lock. A study therefore continues after a
crash as without it, and several processes can work on it at once. Optuna's trials are the
configurations; the runs have a table of their own, because configurations earn further runs after
the sampler has learnt from them, and a finished trial of Optuna cannot change.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import optuna
import yaml
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy import Connection

from scilab_rl.errors import (
    ConfigError,
    MissingDependencyError,
    ScilabRLError,
    did_you_mean,
    listing,
)
from scilab_rl.files import write_text
from scilab_rl.search import outages
from scilab_rl.search.definition import StudyDefinition
from scilab_rl.search.folders import DATABASE, DEFINITION_FILE, STOP_FILE
from scilab_rl.search.locks import FileLocks, Locks, ServerLocks
from scilab_rl.search.run_table import RunTable, create_table
from scilab_rl.search.runs import LOST, RUNNING, Run, RunHistory
from scilab_rl.search.space import Setting

_DEFINITION, _OLD_RUNS, _STOPS = "definition", "run/", "stops"
_LOCK_SECONDS, _ATTEMPTS = 60, 3
_CONNECT_SECONDS = 10
# Processes that a server has dropped come back at different times.
_RETURN_SECONDS = 2 * (_CONNECT_SECONDS + outages.RETRY_SECONDS)
_DRIVERS = {
    "postgres": "postgresql+psycopg",
    "postgresql": "postgresql+psycopg",
    "mysql": "mysql+pymysql",
    "mariadb": "mariadb+pymysql",
}
Result = TypeVar("Result")


class StudyStorage:
    """The memory of one study.

    Args:
        directory: The folder of the study; created when missing.
        storage: Database URL; None means SQLite in the folder.
        directions: ``maximize`` or ``minimize`` for each objective.

    Attributes:
        owner: The name of this process among those that work on the study.
        history: All runs, as last read or written.
        while_waiting: Called about every second while a database server is away, with the seconds
            since the last call.

    Raises:
        ScilabRLError: If the database cannot be opened.
    """

    def __init__(
        self,
        directory: Path,
        storage: str | None = None,
        directions: tuple[str, ...] = ("maximize",),
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        # It prints a traceback for each connection that a server has dropped.
        logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)
        self.directory = directory
        self.url = database_url(directory, storage)
        self.owner = f"{os.getpid()}-{secrets.token_hex(4)}"
        self.history = RunHistory()
        self.while_waiting: Callable[[float], None] = lambda seconds: None
        self._n_stops = 0  # how often the study had been stopped before we began
        self._trials: list[FrozenTrial] | None = None
        self._configurations: dict[int, Setting] | None = None
        with _explained(self.url):
            self._locks = _open_locks(directory, self.url)
            with self.locked():
                database = _open_database(self.url)
                self.study = optuna.create_study(
                    storage=database,
                    study_name=directory.name,
                    directions=[optuna.study.StudyDirection[word.upper()] for word in directions],
                    load_if_exists=True,
                )
                self._table = RunTable(_connector(self._locks, database), self.study._study_id)
                self.runs()
        if any(key.startswith(_OLD_RUNS) for key in self.study.user_attrs):
            raise ScilabRLError(
                f"The study {directory.name} was made by an earlier version, which stored its runs "
                "differently: give another study_name."
            )

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        with self._locks.exclusive():
            self.refresh()  # others may have written since
            yield

    def transact(
        self, work: Callable[[], Result], patience: float = outages.LONGEST_SECONDS
    ) -> Result:
        """Do something under the lock and return its result.

        While a database server is away, wait, and do it again from the newest state.

        Args:
            work: What to do; it reads before it decides.
            patience: Seconds to wait at most.

        Raises:
            DatabaseAwayError: If the server stays away for longer.
        """

        def attempt() -> Result:
            with self.locked():
                return work()

        return outages.outlast(attempt, self.directory.name, patience, self.while_waiting)

    def definition(self) -> StudyDefinition | None:
        """Return what the study was made with, or None for a new one."""
        stored: StudyDefinition | None = self.study.user_attrs.get(_DEFINITION)
        return stored

    def define(self, definition: StudyDefinition) -> None:
        """Store what the study is made with."""
        self.study.set_user_attr(_DEFINITION, dict(definition))

    def runs(self) -> list[Run]:
        """Return all runs in the order of their numbers, as they are now."""
        self.history.update(self._table.read_changes())
        return list(self.history.runs)

    def write_run(self, run: Run) -> None:
        """Store a run, new or changed; requires the lock, and that the runs were read under it."""
        self._table.write(run, is_new=run.number == len(self.history.runs))
        self.history.update([run])

    def trials(self, *states: TrialState) -> list[FrozenTrial]:
        """Return Optuna's trials, all or those in some states, as of the last refresh."""
        if self._trials is None:
            self._trials = self.study.get_trials(deepcopy=False)
        return [trial for trial in self._trials if not states or trial.state in states]

    def configurations(self) -> dict[int, Setting]:
        """Return the configurations of all trials that are more than a refused or torn question."""
        if self._configurations is None:
            self._configurations = {
                trial.number: trial.params
                for trial in self.trials()
                if trial.params and trial.state != TrialState.WAITING
            }
        return self._configurations

    def refresh(self) -> None:
        """Forget the trials that were read; call it after a change."""
        self._trials = self._configurations = None

    def tell(
        self, trial: int, values: Sequence[float] | None = None, state: TrialState | None = None
    ) -> None:
        """Let the sampler know what has become of a configuration."""
        self.study.tell(trial, values, state)
        self.refresh()

    def acquire_lease(self) -> None:
        """Show that this process works on the study, until it ends or releases the lease."""
        self._locks.acquire_lease(self.owner)

    def release_lease(self) -> None:
        """Show that this process no longer works on the study."""
        self._locks.release_lease()

    def recover_lost_runs(self) -> None:
        """Mark runs whose process is gone as lost; requires the lock."""
        running = [run for run in self.runs() if run.state == RUNNING and run.owner != self.owner]
        if time.monotonic() < self._locks.restored + _RETURN_SECONDS:
            return  # a server has just dropped the leases of all processes
        gone = {owner for owner in {r.owner for r in running} if not self._locks.is_alive(owner)}
        for run in running:
            if run.owner in gone:
                self.write_run(run.with_(state=LOST, error="its study was killed"))

    def begin(self) -> None:
        """Start to work on the study, also after an earlier stop; requires the lock."""
        self.acquire_lease()
        (self.directory / STOP_FILE).unlink(missing_ok=True)
        self._n_stops = self._count_stops()

    def request_stop(self) -> None:
        """Ask all processes, on all machines, to start no further run; requires the lock."""
        self.study.set_user_attr(_STOPS, self._count_stops() + 1)

    def must_stop(self) -> bool:
        """Return whether a stop was requested since the beginning; requires the lock."""
        if (self.directory / STOP_FILE).exists():
            (self.directory / STOP_FILE).unlink(missing_ok=True)
            self.request_stop()
        return self._count_stops() > self._n_stops

    def _count_stops(self) -> int:
        return int(self.study.user_attrs.get(_STOPS, 0))


def open_study(directory: Path, storage: str | None = None) -> StudyStorage:
    """Open the memory of an existing study.

    Args:
        directory: Its folder.
        storage: URL of its database; None takes the one that the folder names.

    Raises:
        ConfigError: If the database at the URL does not have it.
    """
    if storage is None:
        return StudyStorage(directory, stored_url(directory))
    names = stored_studies(storage)
    if directory.name not in names:
        raise ConfigError(
            f"There is no study '{directory.name}' in that database."
            f"{did_you_mean(directory.name, names)} There are: {listing(names) or 'none'}."
        )
    study = StudyStorage(directory, storage)
    if not (directory / DEFINITION_FILE).exists():  # from now on, its name suffices here
        write_text(directory / DEFINITION_FILE, yaml.safe_dump({"sweeper": {"storage": storage}}))
    return study


def stored_studies(storage: str) -> list[str]:
    """Return the names of all studies in a database, of which nothing is changed."""
    url = database_url(Path(), storage)
    with _explained(url):
        database = optuna.storages.RDBStorage(url, skip_table_creation=True)
        return sorted(optuna.study.get_all_study_names(database))


def stored_url(directory: Path) -> str:
    """Return the URL of an existing study's database."""
    stored = yaml.safe_load((directory / DEFINITION_FILE).read_text(encoding="utf-8"))
    return database_url(directory, stored["sweeper"]["storage"])


def database_url(directory: Path, storage: str | None) -> str:
    """Return the URL of a study's database, with the driver that we install.

    Args:
        directory: The folder of the study.
        storage: As given; None means SQLite in the folder.
    """
    scheme, separator, rest = (storage or f"sqlite:///{directory / DATABASE}").partition("://")
    return _DRIVERS.get(scheme, scheme) + separator + rest


def _open_locks(directory: Path, url: str) -> Locks:
    if url.startswith("sqlite"):
        return FileLocks(directory / "locks")
    import sqlalchemy

    directory.mkdir(parents=True, exist_ok=True)
    engine = sqlalchemy.create_engine(url, connect_args={"connect_timeout": _CONNECT_SECONDS})
    return ServerLocks(engine, directory.name)


def _open_database(url: str) -> optuna.storages.RDBStorage:
    """Open a database with all tables, patiently: another study may just be making them."""
    engine: dict[str, Any] = {"connect_args": {"timeout": _LOCK_SECONDS}}
    if not url.startswith("sqlite"):
        # A server may have dropped a connection of the pool.
        engine = {"pool_pre_ping": True, "connect_args": {"connect_timeout": _CONNECT_SECONDS}}
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            database = optuna.storages.RDBStorage(url, engine_kwargs=engine)
            create_table(database.engine)
            return database
        except Exception:
            if attempt == _ATTEMPTS:
                raise
            time.sleep(0.5)
    raise AssertionError("the last attempt returns or raises")


def _connector(
    locks: Locks, database: optuna.storages.RDBStorage
) -> Callable[[], AbstractContextManager[Connection]]:
    if isinstance(locks, ServerLocks):
        # A run is written through the connection that holds the lock, or not at all.
        return lambda: contextlib.nullcontext(locks.connection)
    begin: Callable[[], AbstractContextManager[Connection]] = database.engine.begin
    return begin


@contextlib.contextmanager
def _explained(url: str) -> Iterator[None]:
    """Say in one line why a database cannot be opened, without its password."""
    try:
        yield
    except ImportError as error:
        package, extra = ("PyMySQL", "mysql") if url.startswith("m") else ("psycopg", "postgres")
        raise MissingDependencyError(package, extra, f"for {url.partition(':')[0]}") from error
    except Exception as error:
        address = re.sub(r":[^:/@]*@", ":***@", url)
        raise ScilabRLError(
            f"The study's database {address} cannot be opened: {outages.database_message(error)}. "
            "Give another hydra.sweeper.storage, or another study_name."
        ) from error
