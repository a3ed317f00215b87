"""Where a study keeps what it knows: Optuna's database, and locks that die with their process.

Everything is in the database and every decision is made from it under one lock. So a study goes on
after a crash as it would have without, and several processes can work on it at once. The trials
are the settings; the runs are kept as attributes of the study, because settings earn further runs
after the sampler has learnt from them, and a finished trial of Optuna cannot change.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.trial import FrozenTrial, TrialState

from scilab_rl.errors import MissingDependencyError, ScilabRLError
from scilab_rl.files import write_text
from scilab_rl.hyperopt.folders import DATABASE, DEFINITION_FILE, STOP_FILE
from scilab_rl.hyperopt.locks import FileLocks, Locks, ServerLocks
from scilab_rl.hyperopt.runs import LOST, RUNNING, Run

_RUN_KEY, _DEFINITION = "run/", "definition"
_LOCK_SECONDS, _ATTEMPTS = 60, 3
_DRIVERS = {
    "postgres": "postgresql+psycopg",
    "postgresql": "postgresql+psycopg",
    "mysql": "mysql+pymysql",
    "mariadb": "mariadb+pymysql",
}


class Ledger:
    """The memory of one study.

    Args:
        directory: The folder of the study; created when missing.
        storage: Database URL; None means SQLite in the folder.
        directions: ``maximize`` or ``minimize`` for each objective.
    """

    def __init__(
        self,
        directory: Path,
        storage: str | None = None,
        directions: tuple[str, ...] = ("maximize",),
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.directory = directory
        self.url = database_url(directory, storage)
        self.owner = f"{os.getpid()}-{secrets.token_hex(4)}"
        self._trials: list[FrozenTrial] | None = None
        self._locks = _open_locks(directory, self.url)
        with self.locked():
            self.study = optuna.create_study(
                storage=_open_storage(self.url),
                study_name=directory.name,
                directions=[optuna.study.StudyDirection[word.upper()] for word in directions],
                load_if_exists=True,
            )

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        with self._locks.exclusive():
            self.refresh()  # others may have written since
            yield

    def definition(self) -> dict[str, Any] | None:
        """Return what the study was made with, or None for a new one."""
        return self.study.user_attrs.get(_DEFINITION)

    def define(self, definition: Mapping[str, Any]) -> None:
        """Store what the study is made with."""
        self.study.set_user_attr(_DEFINITION, dict(definition))

    def runs(self) -> list[Run]:
        """Return all runs in the order of their numbers."""
        stored = self.study.user_attrs
        return [Run.from_json(stored[key]) for key in sorted(stored) if key.startswith(_RUN_KEY)]

    def write_run(self, run: Run) -> None:
        """Store a run, new or changed."""
        self.study.set_user_attr(f"{_RUN_KEY}{run.number:06d}", run.as_json())

    def trials(self, *states: TrialState) -> list[FrozenTrial]:
        """Return the settings, all or those in some states, as they were at the last refresh."""
        if self._trials is None:
            self._trials = self.study.get_trials(deepcopy=False)
        return [trial for trial in self._trials if not states or trial.state in states]

    def refresh(self) -> None:
        """Forget what was read; call it after a change."""
        self._trials = None

    def tell(
        self, trial: int, values: Sequence[float] | None = None, state: TrialState | None = None
    ) -> None:
        """Let the sampler know what has become of a setting."""
        self.study.tell(trial, values, state)
        self.refresh()

    def sign(self) -> None:
        """Sign as a process that works on the study, until it ends or withdraws."""
        self._locks.sign(self.owner)

    def withdraw(self) -> None:
        """Withdraw the signature."""
        self._locks.withdraw()

    def recover_lost_runs(self, runs: list[Run]) -> list[Run]:
        """Mark runs whose process is gone as lost, and return all runs as they are then."""
        owners = {run.owner for run in runs if run.state == RUNNING} - {self.owner}
        gone = {owner for owner in owners if not self._locks.is_alive(owner)}
        recovered = []
        for run in runs:
            if run.state == RUNNING and run.owner in gone:
                run = run.with_(state=LOST, error="its study was killed")
                self.write_run(run)
            recovered.append(run)
        return recovered

    def allow_running(self) -> None:
        """Create the file that the user deletes to stop the study."""
        write_text(
            self.directory / STOP_FILE,
            "Delete this file to end the study after the running trainings.\n",
        )

    def must_stop(self) -> bool:
        """Tell whether the user has deleted the stop file."""
        return not (self.directory / STOP_FILE).exists()


def open_ledger(directory: Path) -> Ledger:
    """Open the memory of an existing study."""
    return Ledger(directory, stored_url(directory))


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
    directory.mkdir(parents=True, exist_ok=True)
    import sqlalchemy

    with _explained(url):
        return ServerLocks(sqlalchemy.create_engine(url), directory.name)


def _open_storage(url: str) -> optuna.storages.RDBStorage:
    """Open a database, patiently: that of a server may just be made for another study."""
    engine: dict[str, Any] = {"pool_pre_ping": True}  # a server may have dropped a connection
    if url.startswith("sqlite"):
        engine = {"connect_args": {"timeout": _LOCK_SECONDS}}
    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(Exception):
            return optuna.storages.RDBStorage(url, engine_kwargs=engine)
        time.sleep(0.5)
    with _explained(url):
        return optuna.storages.RDBStorage(url, engine_kwargs=engine)


@contextlib.contextmanager
def _explained(url: str) -> Iterator[None]:
    """Say in one line why a database cannot be opened, without its password."""
    try:
        yield
    except ImportError as error:
        package, extra = ("PyMySQL", "mysql") if url.startswith("m") else ("psycopg", "postgres")
        raise MissingDependencyError(package, extra, f"for {url.partition(':')[0]}") from error
    except Exception as error:
        first_line = str(error).strip().partition("\n")[0]
        address = re.sub(r":[^:/@]*@", ":***@", url)
        raise ScilabRLError(
            f"The study's database {address} cannot be opened: {first_line}. "
            "Give another hydra.sweeper.storage, or another study_name."
        ) from error
