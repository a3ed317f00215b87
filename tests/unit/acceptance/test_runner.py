"""Performance tests with real worker processes, whose results are drawn instead of learned."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from scilab_rl.acceptance.conditions import Conditions
from scilab_rl.acceptance.report import Outcome, exit_code, write_reports
from scilab_rl.acceptance.results import TestRun, state_file
from scilab_rl.acceptance.runner import PerformanceTest, PerformanceTestRunner
from scilab_rl.parallel.pool import Pool
from tests.unit.acceptance import toy_worker


def make_test(
    folder: Path, name: str = "Toy/good-test", mean: float = 0.97, code: str = "1", **more: object
) -> PerformanceTest:
    conditions = Conditions(0.9, 300, **more.pop("conditions", {}))
    words = {"mean": mean, "noise": 0.02, "folder": folder, **more}
    return PerformanceTest(
        name, tuple(f"{k}={v}" for k, v in words.items()), conditions, "Toy-v0", "toy", folder,
        {"conditions": {"eval_value": 0.9}, "configuration": {"mean": str(mean)}, "code": code},
    )  # fmt: skip


def work(tests: list[PerformanceTest], size: int = 2, **options: bool) -> list[Outcome]:
    with Pool(size, tests[0].base / "logs", toy_worker.main) as pool:
        runner = PerformanceTestRunner(tests, pool, **options)
        results = runner.work()
    return [
        Outcome(test, result, result.verdict(rule))
        for test, result, rule in zip(tests, results, runner.rules, strict=True)
    ]


def n_trained(folder: Path) -> int:
    return len((folder / "trained.txt").read_text().splitlines())


def test_good_and_bad_tests_get_their_answers(tmp_path: Path) -> None:
    tests = [make_test(tmp_path), make_test(tmp_path, "Toy/bad-test", mean=0.5)]
    good, bad = work(tests)
    assert (good.verdict.outcome, bad.verdict.outcome) == ("pass", "fail")
    assert 3 <= good.verdict.n_runs <= 6
    assert exit_code([good]) == 0
    assert exit_code([good, bad]) == 1


def test_finished_tests_are_not_trained_again_and_unfinished_ones_continue(tmp_path: Path) -> None:
    (outcome,) = work([make_test(tmp_path)])
    n = n_trained(tmp_path)
    (again,) = work([make_test(tmp_path)])
    assert n_trained(tmp_path) == n
    assert again.verdict == outcome.verdict

    path = state_file("Toy/good-test", tmp_path)
    stored = json.loads(path.read_text())
    stored["runs"] = stored["runs"][:2]  # as after a kill
    path.write_text(json.dumps(stored))
    (continued,) = work([make_test(tmp_path)], size=1)
    assert continued.verdict == outcome.verdict  # the seeds are the same
    assert n_trained(tmp_path) == n + outcome.verdict.n_runs - 2


def test_changed_code_begins_anew_unless_told_otherwise(tmp_path: Path) -> None:
    work([make_test(tmp_path)])
    n = n_trained(tmp_path)
    work([make_test(tmp_path, code="2")], any_code=True)
    assert n_trained(tmp_path) == n
    work([make_test(tmp_path, code="2")])
    assert n_trained(tmp_path) >= n + 3


def test_decisions_follow_the_order_of_the_seeds_not_of_the_clock(tmp_path: Path) -> None:
    first_seed = make_test(tmp_path).seed(0)
    (slow,) = work([make_test(tmp_path, slow_seed=first_seed)], size=3)
    assert next(run.seed for run in slow.result.in_order()) == first_seed
    assert slow.verdict.n_runs == len(slow.result.in_order()[: slow.verdict.n_runs])


def test_a_crash_is_an_error_and_no_verdict(tmp_path: Path) -> None:
    (outcome,) = work([make_test(tmp_path, error="loss is nan")])
    assert outcome.verdict.outcome == "error"
    assert "loss is nan" in outcome.explanation()
    assert exit_code([outcome]) == 3


def test_a_killed_worker_is_replaced(tmp_path: Path) -> None:
    (outcome,) = work([make_test(tmp_path, die_once=tmp_path / "died")])
    assert (tmp_path / "died").exists()
    assert outcome.verdict.outcome == "pass"


def test_the_references_rule_takes_the_last_evaluation(tmp_path: Path) -> None:
    conditions = {"rule": "reference", "total_runs": 3, "succ_runs": 2}
    (outcome,) = work([make_test(tmp_path, conditions=conditions)])
    assert (outcome.verdict.outcome, outcome.verdict.n_runs) == ("pass", 2)
    assert make_test(tmp_path, conditions=conditions).task(0).n_final_episodes == 0
    assert make_test(tmp_path).task(0).n_final_episodes == 100


def test_reports_for_people_and_programs(tmp_path: Path) -> None:
    from xml.etree import ElementTree

    outcomes = work([make_test(tmp_path), make_test(tmp_path, "Toy/<bad>-test", mean=0.5)])
    paths = {path.suffix: path for path in write_reports(outcomes, tmp_path / "out")}
    suite = ElementTree.parse(paths[".xml"]).getroot()
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("2", "1", "0")
    assert "| Toy/good-test | pass |" in paths[".md"].read_text()
    page = paths[".html"].read_text()
    assert "Toy/&lt;bad&gt;-test" in page and "<bad>" not in page
    assert page.count("Each line is a run") == 2
    assert [row["outcome"] for row in json.loads(paths[".json"].read_text())] == ["pass", "fail"]


@pytest.mark.parametrize("outcomes", [["pass"], ["inconclusive"], ["fail", "inconclusive"]])
def test_exit_codes(outcomes: list[str], tmp_path: Path) -> None:
    from scilab_rl.acceptance.results import TestResult
    from scilab_rl.acceptance.rules import Verdict

    made = [
        Outcome(make_test(tmp_path), TestResult("t", {}), Verdict(word, 3, 0.9))
        for word in outcomes
    ]
    expected = 1 if "fail" in outcomes else 3 if "inconclusive" in outcomes else 0
    assert exit_code(made) == expected


def test_the_time_left_is_between_the_fewest_and_the_most_runs(tmp_path: Path) -> None:
    """A run took a minute; at least 2 and at most 13 more are needed, two at a time."""
    pool = SimpleNamespace(size=2)
    runner = PerformanceTestRunner([make_test(tmp_path)], pool)  # type: ignore[arg-type]
    assert runner.state() == "0 of 1 tests decided, 0 runs train"
    runner.results[0].runs[0] = TestRun(0, 1, value=0.97, seconds=60.0)
    assert runner.state() == "0 of 1 tests decided, 0 runs train, between 1 and 6 min left"
