"""The memory of a study: what one process writes, the others read, and nothing twice."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from scilab_rl.errors import ScilabRLError
from scilab_rl.search.locks import FileLocks
from scilab_rl.search.runs import COMPLETE, FAILED, LOST, RUNNING, Run, RunHistory
from scilab_rl.search.storage import StudyStorage


def run(number: int, trial: int = 0, state: str = RUNNING, **more: object) -> Run:
    return Run(number, trial, number, 7, state, "somebody", 1.5).with_(**more)


def test_reads_only_what_others_have_changed(tmp_path: Path) -> None:
    ours, other = StudyStorage(tmp_path / "study"), StudyStorage(tmp_path / "study")
    changed = run(1, state=COMPLETE, scores=(0.1 + 0.2,), values=(float("inf"), 1e-300))
    with ours.locked():
        for number in range(3):
            ours.write_run(run(number))
    assert other.runs() == [run(0), run(1), run(2)]
    with ours.locked():
        ours.write_run(changed)
    assert other._table.read_changes() == [changed]
    assert other._table.read_changes() == []
    assert StudyStorage(tmp_path / "study").runs() == [run(0), changed, run(2)]


def test_studies_in_one_database_keep_their_runs_apart(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'shared.db'}"
    one, two = StudyStorage(tmp_path / "one", url), StudyStorage(tmp_path / "two", url)
    one.write_run(run(0))
    assert (len(one.runs()), two.runs()) == (1, [])
    two.write_run(run(0, trial=5))
    assert one.runs()[0].trial == 0


def test_history_counts_a_changed_run_once(tmp_path: Path) -> None:
    history = RunHistory([run(1, state=COMPLETE, scores=(0.5,)), run(0)])
    assert [r.number for r in history.runs] == [0, 1]
    (entry,) = history.entries([0])
    assert (entry.scores, entry.n_running, entry.eliminated) == ((0.5,), 1, False)
    history.update([run(0, state=FAILED)])
    (entry,) = history.entries([0])
    assert (entry.n_running, entry.eliminated, history.n_searched) == (0, True, 2)


def test_study_of_an_earlier_version_is_refused_in_one_line(tmp_path: Path) -> None:
    StudyStorage(tmp_path / "study").study.set_user_attr("run/000000", {"number": 0})
    with pytest.raises(ScilabRLError, match=r"^The study study was made by an earlier version"):
        StudyStorage(tmp_path / "study")


def test_runs_are_not_lost_while_processes_return_to_a_server(tmp_path: Path) -> None:
    storage = StudyStorage(tmp_path / "study")
    storage.write_run(run(0))
    storage._locks.restored = time.monotonic()
    storage.recover_lost_runs()
    assert storage.runs()[0].state == RUNNING
    storage._locks.restored = time.monotonic() - 60
    storage.recover_lost_runs()
    assert storage.runs()[0].state == LOST


def test_asking_for_a_lease_leaves_no_file(tmp_path: Path) -> None:
    locks = FileLocks(tmp_path)
    assert not locks.is_alive("nobody")
    assert not list(tmp_path.iterdir())
