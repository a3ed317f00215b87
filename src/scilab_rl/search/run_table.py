"""The table of all runs in a study's database, of which each process reads only what is new."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager

import sqlalchemy
from sqlalchemy.dialects.mysql import MEDIUMTEXT

from scilab_rl.search.runs import Run

_METADATA = sqlalchemy.MetaData()
RUNS = sqlalchemy.Table(
    "scilab_rl_runs",
    _METADATA,
    sqlalchemy.Column("study_id", sqlalchemy.Integer, primary_key=True, autoincrement=False),
    sqlalchemy.Column("number", sqlalchemy.Integer, primary_key=True, autoincrement=False),
    # Counts the changes of a study, so that one can ask for those since the last look.
    sqlalchemy.Column("version", sqlalchemy.BigInteger, nullable=False),
    sqlalchemy.Column("state", sqlalchemy.String(16), nullable=False),
    # JSON of a `Run`; as text, because a learning curve may hold NaN.
    sqlalchemy.Column(
        "run", sqlalchemy.Text().with_variant(MEDIUMTEXT(), "mysql", "mariadb"), nullable=False
    ),
    sqlalchemy.Index("scilab_rl_runs_version", "study_id", "version"),
)


def create_table(engine: sqlalchemy.Engine) -> None:
    """Create the table where it is missing."""
    _METADATA.create_all(engine)


class RunTable:
    """The runs of one study.

    Args:
        connect: Returns a connection for a block. Writing requires the lock of the study.
        study_id: Optuna's number of the study.
    """

    def __init__(
        self, connect: Callable[[], AbstractContextManager[sqlalchemy.Connection]], study_id: int
    ) -> None:
        self._connect = connect
        self._study_id = study_id
        self._version = 0

    def read_changes(self) -> list[Run]:
        """Return the runs that are new or have changed since the last call."""
        query = (
            sqlalchemy.select(RUNS.c.version, RUNS.c.run)
            .where(RUNS.c.study_id == self._study_id, RUNS.c.version > self._version)
            .order_by(RUNS.c.version)
        )
        with self._connect() as connection:
            rows = connection.execute(query).all()
        if rows:
            self._version = rows[-1].version
        return [Run.from_json(json.loads(row.run)) for row in rows]

    def write(self, run: Run, *, is_new: bool) -> None:
        """Store a run; all changes of other processes must have been read before."""
        values = {
            "version": self._version + 1, "state": run.state, "run": json.dumps(run.as_json())
        }  # fmt: skip
        key = {"study_id": self._study_id, "number": run.number}
        with self._connect() as connection:
            if is_new:
                connection.execute(RUNS.insert().values(**key, **values))
            else:
                connection.execute(RUNS.update().filter_by(**key).values(**values))
        self._version += 1
