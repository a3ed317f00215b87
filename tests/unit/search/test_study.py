"""Studies with real worker processes and real storage, whose runs are formulas."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
from optuna.trial import TrialState

from scilab_rl.errors import ScilabRLError
from scilab_rl.search.folders import DATABASE, STOP_FILE
from scilab_rl.search.runs import COMPLETE, FAILED, LOST, PRUNED, RUNNING
from scilab_rl.search.space import SearchSpace
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.summary import summarize

from . import toy

ROOT = Path(__file__).parents[3]


def searched(study):
    """The runs of the search, without the re-evaluation of the winner."""
    return [run for run in study.runs if not run.is_final]


def test_spends_exactly_its_budget_and_pairs_the_seeds(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", pruner="none")
    runs = searched(study)
    assert len(runs) == 12
    assert {run.state for run in study.runs} == {COMPLETE}
    seeds = {}
    for run in runs:
        seeds.setdefault(run.repeat, set()).add(run.seed)
    assert all(len(of_repeat) == 1 for of_repeat in seeds.values())
    assert len(set.union(*seeds.values())) == len(seeds)
    per_setting = Counter(run.trial for run in runs)
    assert min(per_setting.values()) == 2
    told = study.storage.trials(TrialState.COMPLETE)
    assert {trial.number for trial in told} == set(per_setting)


def test_winner_is_re_evaluated_with_seeds_of_its_own(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", n_final_runs=3, pruner="none")
    finals = [run for run in study.runs if run.is_final]
    assert [run.trial for run in finals] == [study.winner()] * 3
    assert not {run.seed for run in finals} & {run.seed for run in searched(study)}


def test_small_space_is_tried_completely_and_then_raced(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", space=toy.CHOICES, max_trials=16, pruner="none")
    settings = study.storage.configurations()
    assert sorted(s["x"] for s in settings.values()) == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert settings[study.winner()]["x"] in (0.5, 0.75)
    runs = Counter(settings[run.trial]["x"] for run in searched(study))
    assert runs[0.0] == 2, "0.0 is far behind and must not earn further repeats"


def test_space_that_takes_the_whole_budget_is_tried_completely(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", space=toy.CHOICES, max_trials=10, pruner="none")
    assert sorted(Counter(run.trial for run in searched(study)).values()) == [2] * 5


@pytest.mark.parametrize("space", [toy.SPACE, toy.CHOICES])
def test_what_the_configuration_has_is_tried_first(tmp_path: Path, space: SearchSpace) -> None:
    study = toy.run(
        tmp_path / "study", space=space, max_trials=10, pruner="none", baseline={"x": 0.25}
    )
    settings = study.storage.configurations()
    assert settings[study.runs[0].trial] == {"x": 0.25}
    values = [setting["x"] for setting in settings.values()]
    assert len(set(values)) == len(values) > 3


def test_grid_keeps_its_order(tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", space=toy.CHOICES, sampler="grid", max_trials=10, pruner="none",
        n_workers=1, baseline={"x": 0.75},
    )  # fmt: skip
    values = [setting["x"] for setting in study.storage.configurations().values()]
    assert values == [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.mark.slow
def test_f16_one_worker_draws_the_same_settings_after_a_kill(tmp_path: Path) -> None:
    whole = toy.run(tmp_path / "whole", n_workers=1, max_trials=8)
    process = start(tmp_path / "parts", 8, n_workers=1)
    wait_for_runs(tmp_path / "parts", 3)
    process.kill()
    process.communicate()
    resumed = toy.run(tmp_path / "parts", n_workers=1, max_trials=8)
    wanted, found = map(settings_and_scores, (whole, resumed))
    assert found == wanted


@pytest.mark.parametrize("fault", ["kill", "segfault", "exit"])
def test_f15_dead_worker_is_replaced_and_its_run_repeated(fault: str, tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", f"die={fault}", f"once={tmp_path / 'died'}", max_trials=4)
    assert {run.state for run in study.runs} == {COMPLETE}
    assert [run.attempt for run in study.runs].count(1) == 1
    assert len(searched(study)) == 4


def test_f15_run_that_always_kills_its_worker_fails_and_never_scores(tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", "die=kill", "where=0.75", space=toy.CHOICES, max_retries=1,
        max_trials=14,
    )  # fmt: skip
    bad = [run for run in study.runs if run.state == FAILED]
    settings = study.storage.configurations()
    assert {settings[run.trial]["x"] for run in bad} == {0.75}
    assert all(run.attempt == 1 and "SIGKILL" in run.error and not run.scores for run in bad)
    assert settings[study.winner()]["x"] != 0.75
    told = [t.number for t in study.storage.trials(TrialState.FAIL)]
    assert told == [bad[0].trial]


def test_f15_hanging_run_is_killed_after_its_timeout(tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", "die=hang", "where=0.25", space=toy.CHOICES, trial_timeout=1,
        max_trials=10,
    )  # fmt: skip
    late = [run for run in study.runs if run.state == FAILED]
    assert late
    assert all("trial_timeout" in run.error for run in late)


@pytest.mark.parametrize("direction", ["maximize", "minimize"])
def test_f12_nan_never_wins(direction: str, tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", "nan=1", direction=direction, fail_fast=0, max_trials=4)
    assert {run.state for run in study.runs} == {FAILED}
    assert "not a finite number" in study.runs[0].error
    assert study.winner() is None


def test_f19_ends_early_when_the_first_runs_fail_alike(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", "error=boom at step 3", max_trials=40)
    assert "first 5 runs all failed: boom" in study.stop.reason
    assert len(study.runs) <= 6
    assert study.winner() is None


@pytest.mark.parametrize("pruner", ["median", "percentile", "hyperband"])
def test_hopeless_runs_are_pruned_and_their_settings_are_out(pruner: str, tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", max_trials=26, pruner=pruner, pruner_warmup_epochs=1)
    pruned = [run for run in study.runs if run.state == PRUNED]
    assert pruned
    assert all(1 < len(run.values) < toy.N_EPOCHS for run in pruned if run.repeat == 0)
    assert study.winner() not in {run.trial for run in pruned}
    out = {run.trial for run in pruned}
    told = {trial.number for trial in study.storage.trials(TrialState.PRUNED)}
    assert told == out


@pytest.mark.slow
def test_several_objectives_give_every_setting_the_same_repeats(tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", score=["final", "steps_to_threshold"],
        direction=["maximize", "minimize"], max_trials=6,
    )  # fmt: skip
    assert {len(run.scores) for run in study.runs} == {2}
    assert set(Counter(run.trial for run in study.runs).values()) == {2}
    assert study.storage.study.best_trials


@pytest.mark.parametrize("by_file", [True, False])
def test_stop_ends_the_study_after_the_running_runs_and_it_can_continue(
    by_file: bool, tmp_path: Path
) -> None:
    def stop_soon_after_the_start() -> None:
        wait_for_runs(tmp_path / "study", 3)
        if by_file:
            (tmp_path / "study" / STOP_FILE).touch()
        else:
            other = StudyStorage(tmp_path / "study")
            other.transact(other.request_stop)

    threading.Thread(target=stop_soon_after_the_start).start()
    study = toy.run(tmp_path / "study", "seconds=0.3", max_trials=200)
    assert "study stop" in study.stop.reason
    assert {run.state for run in study.runs} <= {COMPLETE, PRUNED}
    n_stopped = len(study.runs)
    assert 0 < n_stopped < 100
    assert not (tmp_path / "study" / STOP_FILE).exists()
    (tmp_path / "study" / STOP_FILE).touch()  # while nothing runs
    study = toy.run(tmp_path / "study", max_trials=n_stopped + 4)
    assert not study.stop.reason
    assert n_stopped < len(searched(study)) <= n_stopped + 4


def test_duration_ends_the_study_after_the_running_runs(tmp_path: Path) -> None:
    study = toy.run(tmp_path / "study", "seconds=0.3", max_trials=200, max_duration_minutes=0.02)
    assert study.stop.reason == "stopped after 0.02 minutes"
    assert {run.state for run in study.runs} <= {COMPLETE, PRUNED}


def test_ctrl_c_ends_the_study_after_the_running_runs(tmp_path: Path) -> None:
    process = start(tmp_path / "study", 200)
    wait_for_runs(tmp_path / "study", 3)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=20)
    assert output == "stopped by SIGINT\n"
    assert {run.state for run in StudyStorage(tmp_path / "study").runs()} <= {COMPLETE, PRUNED}


def test_f16_killed_parent_takes_its_workers_along_and_loses_nothing(tmp_path: Path) -> None:
    process = start(tmp_path / "study", 10)
    wait_for_runs(tmp_path / "study", 3)
    children = descendants(process.pid)
    assert children
    process.kill()
    process.communicate()
    before = {r.number: r for r in StudyStorage(tmp_path / "study").runs() if r.state == COMPLETE}
    assert wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children))
    study = toy.run(tmp_path / "study", max_trials=10)
    after = {run.number: run for run in study.runs}
    assert all(after[number] == run for number, run in before.items())
    assert [run.number for run in study.runs] == list(range(11))
    assert not [run for run in study.runs if run.state in (RUNNING, LOST)]


def test_f18_database_with_leftovers_of_a_crash_opens(tmp_path: Path) -> None:
    toy.run(tmp_path / "study", max_trials=4)
    (tmp_path / "study" / f"{DATABASE}-journal").write_bytes(b"torn")
    (tmp_path / "study" / "locks" / "1-dead.lease").touch()
    study = toy.run(tmp_path / "study", max_trials=6)
    assert len(searched(study)) == 6


def test_f17_two_parents_share_one_budget(tmp_path: Path) -> None:
    processes = [start(tmp_path / "study", 12) for _ in range(2)]
    outputs = [process.communicate(timeout=60) for process in processes]
    assert [output for output, _ in outputs] == ["finished\n"] * 2, outputs
    runs = StudyStorage(tmp_path / "study").runs()
    assert len([run for run in runs if not run.is_final]) == 12
    assert [run.number for run in runs] == list(range(13))
    assert len({(run.trial, run.repeat) for run in runs}) == 13
    assert len({run.owner for run in runs}) == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_f16_killed_again_and_again_ends_with_the_exact_total(seed: int, tmp_path: Path) -> None:
    """SIGKILL at random moments until it is done, as in Ray's stress test."""
    rng, n_kills, process = random.Random(seed), 0, start(tmp_path / "study", 30)
    while not ended_or_progressed(process, tmp_path / "study", rng.randint(1, 5)):
        time.sleep(rng.uniform(0.0, 0.5))
        n_kills += process.poll() is None
        process.kill()
        process.communicate()
        process = start(tmp_path / "study", 30)
    runs = StudyStorage(tmp_path / "study").runs()
    assert n_kills >= 3
    assert len([run for run in runs if not run.is_final]) == 30
    assert not [run for run in runs if run.state in (RUNNING, LOST)]
    assert len({(run.trial, run.repeat) for run in runs}) == len(runs)


@pytest.mark.slow
def test_f17_two_parents_share_again_and_again(tmp_path: Path) -> None:
    for repetition in range(20):
        folder = tmp_path / f"study{repetition}"
        processes = [start(folder, 10) for _ in range(2)]
        for process in processes:
            output, errors = process.communicate(timeout=120)
            assert (output, "locked" in errors) == ("finished\n", False), errors
        runs = StudyStorage(folder).runs()
        assert [run.number for run in runs] == list(range(11))
        assert len({(run.trial, run.repeat) for run in runs}) == 11
        assert {run.state for run in runs} == {COMPLETE}


@pytest.mark.slow
def test_f17_eight_processes_open_a_study_first(tmp_path: Path) -> None:
    """Each makes the tables, unless another is faster."""
    code = (
        "import sys; from pathlib import Path; "
        "from scilab_rl.search.storage import StudyStorage; "
        "storage = StudyStorage(Path(sys.argv[1])); sys.stdin.read()"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path / "study")],
            stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for _ in range(8)
    ]  # fmt: skip
    errors = [process.communicate(timeout=120)[1] for process in processes]
    assert [process.returncode for process in processes] == [0] * 8, errors
    assert len(toy.run(tmp_path / "study", max_trials=2).runs) == 3


def test_f18_locked_database_is_waited_for(tmp_path: Path) -> None:
    toy.run(tmp_path / "study", max_trials=2)
    other = sqlite3.connect(tmp_path / "study" / DATABASE, check_same_thread=False)
    other.execute("BEGIN EXCLUSIVE")
    threading.Timer(2.0, other.rollback).start()
    started = time.monotonic()
    study = toy.run(tmp_path / "study", max_trials=4)
    assert time.monotonic() - started >= 1.5
    assert len(searched(study)) == 4
    other.close()


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_f18_torn_database_is_said_in_one_line(kept: float, tmp_path: Path) -> None:
    toy.run(tmp_path / "study", max_trials=2)
    database = tmp_path / "study" / DATABASE
    whole = database.read_bytes()
    database.write_bytes(whole[: int(kept * len(whole))] + b"torn")
    with pytest.raises(ScilabRLError, match=r"cannot be opened: [^\n]*another study_name"):
        StudyStorage(tmp_path / "study").runs()


@pytest.mark.parametrize("value", ["nan", "infinite", "text", "nothing", "several"])
def test_f19_score_that_is_no_number_never_wins(value: str, tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", score=f"{toy.__package__}.bad_scores.{value}", max_trials=20,
        fail_fast=3,
    )  # fmt: skip
    failed = [run for run in study.runs if run.state == FAILED]
    assert all("not a finite number" in run.error for run in failed)
    # A repeat is stopped when its setting has failed meanwhile.
    assert {run.trial for run in study.runs} == {run.trial for run in failed}
    assert not [run for run in study.runs if run.scores]
    assert study.winner() is None
    assert "first 3 runs all failed" in study.stop.reason
    assert (
        dict(summarize(study.storage).facts())["best configuration"] == "none: no run is complete"
    )
    assert not study.storage.trials(TrialState.COMPLETE)


def ended_or_progressed(process: subprocess.Popen, directory: Path, count: int) -> bool:
    """Wait until a study has finished, or until it has done some more runs."""

    def n_done() -> int:
        known = (directory / DATABASE).exists()
        return sum(run.state == COMPLETE for run in StudyStorage(directory).runs()) if known else 0

    before = n_done()
    assert wait_until(lambda: process.poll() is not None or n_done() >= before + count, 120)
    if process.poll() is None:
        return False
    output, errors = process.communicate()
    assert output == "finished\n", errors
    return True


def settings_and_scores(study) -> list[tuple]:
    settings = study.storage.configurations()
    return [(settings[run.trial], run.repeat, run.scores) for run in study.runs]


def start(
    directory: Path, max_trials: int, n_workers: int = 2, storage: str = "", pruner: str = "median"
) -> subprocess.Popen:
    given = map(str, (directory, max_trials, n_workers, storage, pruner))
    return subprocess.Popen(
        [sys.executable, "-m", "tests.unit.search.toy", *given],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def wait_for_runs(directory: Path, count: int) -> None:
    def enough() -> bool:
        done = (directory / DATABASE).exists() and StudyStorage(directory).runs()
        return bool(done) and sum(run.state == COMPLETE for run in done) >= count

    assert wait_until(enough)


def wait_until(condition, seconds: float = 30.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.1)
    return False


def descendants(pid: int) -> list[int]:
    import psutil

    return [child.pid for child in psutil.Process(pid).children(recursive=True)]
