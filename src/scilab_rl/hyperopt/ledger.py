"""Where a study keeps what it knows: Optuna's database, and locks that die with their process.

Everything is in the database and every decision is made from it under one lock. So a study goes on
after a crash as it would have without, and several processes can work on it at once. The trials
are the settings; the runs are kept as attributes of the study, because settings earn further runs
after the sampler has learnt from them, and a finished trial of Optuna cannot change.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import optuna
import yaml
from optuna.trial import FrozenTrial, TrialState

from scilab_rl.errors import ScilabRLError
from scilab_rl.files import write_text
from scilab_rl.hyperopt.folders import DATABASE, DEFINITION_FILE, STOP_FILE
from scilab_rl.hyperopt.runs import LOST, RUNNING, Run

_RUN_KEY, _DEFINITION = "run/", "definition"
_LOCK_SECONDS = 60


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
        (directory / "locks").mkdir(parents=True, exist_ok=True)
        self.owner = f"{os.getpid()}-{secrets.token_hex(4)}"
        self._lease: IO[str] | None = None
        self._trials: list[FrozenTrial] | None = None
        with self.locked():
            self.study = optuna.create_study(
                storage=_open_storage(storage or f"sqlite:///{directory / DATABASE}"),
                study_name=directory.name,
                directions=[optuna.study.StudyDirection[word.upper()] for word in directions],
                load_if_exists=True,
            )

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep all other processes out of this study for the moment of a decision."""
        with (self.directory / "locks" / "study.lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
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

    def hold_lease(self) -> None:
        """Sign as alive; the kernel withdraws the signature when this process ends, however."""
        self._lease = self._lease_path(self.owner).open("w")
        fcntl.flock(self._lease, fcntl.LOCK_EX)

    def release_lease(self) -> None:
        """Withdraw the signature."""
        if self._lease is not None:
            self._lease.close()
            self._lease_path(self.owner).unlink(missing_ok=True)
            self._lease = None

    def recover_lost_runs(self, runs: list[Run]) -> list[Run]:
        """Mark runs whose process is gone as lost, and return all runs as they are then."""
        owners = {run.owner for run in runs if run.state == RUNNING} - {self.owner}
        gone = {owner for owner in owners if not self._is_alive(owner)}
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

    def _lease_path(self, owner: str) -> Path:
        return self.directory / "locks" / f"{owner}.lease"

    def _is_alive(self, owner: str) -> bool:
        try:
            with self._lease_path(owner).open() as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        self._lease_path(owner).unlink(missing_ok=True)
        return False


def open_ledger(directory: Path) -> Ledger:
    """Open the memory of an existing study."""
    stored = yaml.safe_load((directory / DEFINITION_FILE).read_text(encoding="utf-8"))
    return Ledger(directory, stored["sweeper"]["storage"])


def _open_storage(url: str) -> optuna.storages.RDBStorage:
    """Open a database, patiently: another process may be writing."""
    engine = {"connect_args": {"timeout": _LOCK_SECONDS}} if url.startswith("sqlite") else None
    for attempt in range(3):
        try:
            return optuna.storages.RDBStorage(url, engine_kwargs=engine)
        except Exception as error:
            if attempt == 2:
                first_line = str(error).strip().partition("\n")[0]
                raise ScilabRLError(
                    f"The study's database {url} cannot be opened: {first_line}. "
                    "Give another hydra.sweeper.storage, or another study_name."
                ) from error
            time.sleep(0.5)
    raise AssertionError("unreachable")
