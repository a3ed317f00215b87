"""A new result is held against its baseline, in learning and in speed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from scilab_rl.acceptance.baselines import compare, read_baseline, write_baseline
from scilab_rl.acceptance.results import TestResult, TestRun
from scilab_rl.acceptance.rules import Verdict
from scilab_rl.errors import ConfigError

MACHINE = {"processor": "x", "cores": 2}


def result(values: list[float], speed: float = 100.0, **source: object) -> TestResult:
    runs = {
        i: TestRun(i, i + 1, value, 1000, 10.0, speed * (1 + 0.01 * i), (500, 1000), (0.1, value),
                   run_dir="/home/somebody/data/run")
        for i, value in enumerate(values)
    }  # fmt: skip
    about = {"machine": MACHINE, "fingerprint": "abc", **source}
    definition = {"configuration": {"algorithm.gamma": "0.9"}, "conditions": {}, "code": "1"}
    return TestResult("Toy/good-test", definition, runs, about)


def test_a_baseline_is_stored_without_places_of_this_machine(tmp_path: Path) -> None:
    versions = {"torch": "2.13", "some-unrelated-package": "1"}
    path = write_baseline(
        result([0.9, 1.0, 0.95], versions=versions), Verdict("pass", 3, 0.95), tmp_path
    )
    assert path == tmp_path / "Toy" / "good-test.json"
    stored = json.loads(path.read_text())
    assert stored["source"]["versions"] == {"torch": "2.13"}
    assert stored["runs"][0]["curve"] == [0.1, 0.9]
    assert "somebody" not in path.read_text()
    read = read_baseline("Toy/good-test", tmp_path)
    assert read is not None and [run.value for run in read.in_order()] == [0.9, 1.0, 0.95]
    assert read_baseline("Toy/other-test", tmp_path) is None


def test_worse_learning_is_found_with_its_interval() -> None:
    found = compare(result([0.6, 0.65, 0.7]), result([0.9, 0.95, 1.0]))
    assert found is not None and found.worse
    assert found.learning.value == pytest.approx(-0.3)
    assert found.learning.low < -0.3 < found.learning.high < 0
    assert found.lines()[0].startswith("WORSE than the baseline: mean -0.3 (95 % interval")


def test_equal_learning_is_no_worsening() -> None:
    found = compare(result([0.9, 0.96, 0.98]), result([0.9, 0.95, 1.0]))
    assert found is not None and not found.worse
    assert found.speed is not None and found.speed.value == pytest.approx(1.0)


def test_slower_training_is_found_on_the_same_machine_only() -> None:
    new, old = result([0.9, 0.95, 1.0], speed=50), result([0.9, 0.95, 1.0], speed=100)
    found = compare(new, old)
    assert found is not None and found.slower and found.speed is not None
    assert found.speed.value == pytest.approx(0.5)
    elsewhere = compare(result([0.9, 0.95, 1.0], speed=50, machine={"cores": 8}), old)
    assert elsewhere is not None and not elsewhere.slower
    assert "another machine: speeds cannot be compared" in elsewhere.notes


def test_differences_of_environment_and_configuration_are_told() -> None:
    new = result([0.9, 0.95, 1.0], fingerprint="xyz")
    new.definition = {**new.definition, "configuration": {"algorithm.gamma": "0.99"}}
    found = compare(new, result([0.9, 0.95, 1.0]))
    assert found is not None
    assert any("fingerprint xyz, was abc" in note for note in found.notes)
    assert any("algorithm.gamma: 0.99 (was 0.9)" in note for note in found.notes)


def test_too_few_runs_compare_with_nothing() -> None:
    assert compare(result([0.9, 0.9]), result([0.9, 0.95, 1.0])) is None


def test_a_damaged_baseline_is_named(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text("{")
    with pytest.raises(ConfigError, match=r"t\.json' is damaged"):
        read_baseline("t", tmp_path)
