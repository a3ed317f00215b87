"""Performance tests from the command line, with an algorithm that cannot learn and is fast."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.commands import ROOT, scilab_rl

TEST = """# @package _global_
defaults:
  - override /algorithm: random

env: {env}
eval_after_n_steps: 20
n_test_rollouts: 2
mlflow: 0

performance_testing_conditions:
  eval_columns: eval/mean_reward
  eval_value: {value}
  max_steps: 40
  margin: 400
  n_episodes: 5
  tier: pr
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with a test that random actions pass and one that they cannot pass."""
    folder = tmp_path / "conf" / "performance" / "Tiny"
    folder.mkdir(parents=True)
    env = "scilab_rl.testing:TinyBox-v0"
    (folder / "easy-test.yaml").write_text(TEST.format(env=env, value=-500))
    (folder / "impossible-test.yaml").write_text(TEST.format(env=env, value=900))
    return tmp_path


def test_the_papers_command_runs_a_performance_test(project: Path) -> None:
    done = scilab_rl("+performance=Tiny/easy-test", "--multirun", cwd=project)
    assert done.returncode == 0, done.stderr
    assert "Tiny/easy-test: pass." in done.stderr
    report = json.loads((project / "data" / "performance" / "report.json").read_text())
    assert report[0]["outcome"] == "pass"
    assert report[0]["runs"][0]["steps"] == 40
    assert len({run["seed"] for run in report[0]["runs"]}) == len(report[0]["runs"])


def test_a_failed_test_has_exit_code_1(project: Path) -> None:
    done = scilab_rl("+performance=Tiny/impossible-test", "--multirun", cwd=project)
    assert done.returncode == 1
    assert "did not pass, first Tiny/impossible-test (fail)" in done.stderr


def test_without_multirun_the_file_is_one_run(project: Path) -> None:
    done = scilab_rl("+performance=Tiny/easy-test", "seed=1", "n_epochs=1", cwd=project)
    assert done.returncode == 0, done.stderr
    assert "performance_testing_conditions" not in (project / "data/last/config.yaml").read_text()


def test_a_sweep_inside_a_test_is_refused(project: Path) -> None:
    done = scilab_rl("+performance=Tiny/easy-test", "n_envs=1,2", "--multirun", cwd=project)
    assert done.returncode == 2
    assert "one value of each key" in done.stderr


def test_the_command_selects_runs_reports_and_keeps_baselines(project: Path) -> None:
    listed = scilab_rl("performance", "Tiny/", "--list", cwd=project)
    assert [line.split("\t")[0] for line in listed.stdout.splitlines()[1:]] == [
        "Tiny/easy-test", "Tiny/impossible-test",
    ]  # fmt: skip
    done = scilab_rl("performance", "Tiny/", "--jobs", "1", "--write-baselines", cwd=project)
    assert done.returncode == 1, done.stderr
    rows = [line.split("\t")[:2] for line in done.stdout.splitlines()[1:]]
    assert rows == [["Tiny/easy-test", "pass"], ["Tiny/impossible-test", "fail"]]
    stored = json.loads((project / "baselines" / "Tiny" / "easy-test.json").read_text())
    assert stored["source"]["fingerprint"] and stored["source"]["versions"]["torch"]
    assert stored["runs"][0]["curve_steps"] == [20, 40]

    again = scilab_rl("performance", "Tiny/easy", cwd=project)
    assert again.returncode == 0
    assert "run 1" not in again.stderr  # nothing was trained again
    assert "compared with the baseline: mean +0" in again.stdout


def test_an_unknown_test_is_named(project: Path) -> None:
    done = scilab_rl("performance", "FetchReech/sac_her-test", cwd=project)
    assert done.returncode == 2
    assert "Did you mean 'FetchReach/sac_her-test'?" in done.stderr


def test_the_scripts_exist_and_can_be_run() -> None:
    for name in ("run_performance_tests.sh", "run_smoke_tests.sh"):
        assert (ROOT / "scripts" / name).stat().st_mode & 0o111
