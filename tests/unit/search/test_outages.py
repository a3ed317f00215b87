"""A database that is away is waited for; any other error is not."""

from __future__ import annotations

import sqlite3
from collections import Counter
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError, PendingRollbackError, ProgrammingError

from scilab_rl.search import outages
from scilab_rl.search.outages import DatabaseAwayError, is_outage, outlast
from scilab_rl.search.run_table import RunTable
from scilab_rl.search.runs import COMPLETE

from . import toy

CLOSED = Exception("server closed the connection\nsecond line")


def lost(statement: str | None = "UPDATE x") -> OperationalError:
    return OperationalError(statement, {}, CLOSED, connection_invalidated=statement is not None)


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outages, "RETRY_SECONDS", 0.01)


@pytest.mark.parametrize("error", [lost(), lost(None), PendingRollbackError("x")])
def test_waits_and_says_so_once(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    answers, waited = [error, error, 7], []

    def work() -> int:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    assert outlast(work, "mine", 60, waited.append) == 7
    assert len(waited) == 2 and all(0 < seconds < 5 for seconds in waited)
    first, second = caplog.messages
    assert "does not answer" in first
    assert second == "The database is back; the study mine continues."


def test_gives_up_with_the_true_reason() -> None:
    def work() -> None:
        raise RuntimeError("in Optuna") from lost()

    with pytest.raises(DatabaseAwayError, match=r"\(server closed the connection\)[^\n]*same"):
        outlast(work, "mine", 0.05, lambda seconds: None)


@pytest.mark.parametrize(
    "error",
    [
        ProgrammingError("SELECT x", {}, CLOSED),
        OperationalError("SELECT x", {}, Exception("disk full")),
        OperationalError(None, {}, sqlite3.OperationalError("unable to open database file")),
        KeyError("x"),
    ],
)
def test_other_errors_are_raised_at_once(error: Exception) -> None:
    assert not is_outage(error)


def test_time_without_the_database_does_not_count_as_training(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", max_trials=2, trial_timeout=5)
    limits: list[float] = []
    study.pool.kill_older_than = lambda seconds: limits.append(seconds) or []
    study.storage.while_waiting(100.0)
    study._end_late_runs()
    assert limits == [105.0]


@pytest.mark.parametrize("is_written", [True, False])
def test_runs_stay_exact_when_the_database_goes_away(
    is_written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every third write breaks, before the run is stored, or after, when nobody can know."""
    calls, write = Counter[str](), RunTable.write

    def breaking(table: RunTable, *given: object, **named: object) -> None:
        calls["all"] += 1
        breaks = calls["all"] % 3 == 0
        if is_written or not breaks:
            write(table, *given, **named)  # type: ignore[arg-type]
        if breaks:
            table._version -= is_written  # the answer never came
            raise lost()

    monkeypatch.setattr(RunTable, "write", breaking)
    study = toy.run(tmp_path / "study", max_trials=6, pruner="none")
    assert [run.number for run in study.runs] == list(range(7))
    assert {run.state for run in study.runs} == {COMPLETE}
    assert {run.attempt for run in study.runs} == {0}
    assert len({(run.trial, run.repeat) for run in study.runs}) == 7
