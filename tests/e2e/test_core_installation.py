"""An installation without extras trains, searches and compares, to the end of its reports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.commands import ROOT, TINY, command, quiet_environment

SHORT = (TINY, "eval_after_n_steps=60", "n_epochs=2", "n_test_rollouts=2")


def run(core_alone: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess:
    paths = f"{core_alone}:{ROOT / 'src'}"
    return subprocess.run(
        [sys.executable, *command(*arguments)[1:]], cwd=cwd, text=True, capture_output=True,
        timeout=240, check=False, env=quiet_environment(PYTHONPATH=paths),
    )  # fmt: skip


def test_extras_are_out_of_reach(core_alone: Path, tmp_path: Path) -> None:
    code = "import matplotlib, PIL, yaml\nimport mlflow"
    done = subprocess.run(
        [sys.executable, "-c", code], env=quiet_environment(PYTHONPATH=str(core_alone)),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "No module named 'mlflow'" in done.stderr


def test_an_experiment_ends_with_its_report(core_alone: Path, tmp_path: Path) -> None:
    words = ("experiment", "base=random", "variant=two:random,n_envs=2", "seeds=2", *SHORT)
    done = run(core_alone, tmp_path, *words)
    assert done.returncode == 0, done.stderr
    (page,) = tmp_path.glob("data/comparisons/*/comparison.html")
    assert page.stat().st_size > 10_000


def test_a_study_ends_with_its_report(core_alone: Path, tmp_path: Path) -> None:
    words = ("algorithm=sac", *SHORT, "algorithm.buffer_size=500", "--multirun",
             "algorithm.learning_starts=1000", "require_updates=false",
             "algorithm.gamma=interval(0.9,0.99)",
             "hydra.sweeper.max_trials=2", "hydra.sweeper.min_trials_per_param=1",
             "hydra.sweeper.n_final_runs=0", "hydra.sweeper.study_name=mine")  # fmt: skip
    done = run(core_alone, tmp_path, *words)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "data/studies/mine/report.html").stat().st_size > 10_000


def test_agents_play_or_name_the_extra_that_they_need(core_alone: Path, tmp_path: Path) -> None:
    done = run(core_alone, tmp_path, "play", "agent:Reach1DOF", "--episodes", "2")
    assert done.returncode == 0, done.stderr
    done = run(core_alone, tmp_path, "play", "agent:FetchReach", "--episodes", "2")
    assert done.returncode == 2 and 'pip install "scilab-rl[jax]"' in done.stderr


def test_the_api_works_and_tables_name_the_extra_that_they_need(
    core_alone: Path, tmp_path: Path
) -> None:
    code = (
        "import scilab_rl\n"
        f"run = scilab_rl.train('{TINY[4:]}', 'random', n_epochs=1, eval_after_n_steps=30)\n"
        "assert run.plot()._repr_png_() and run.epochs\n"
        "try:\n    run.metrics\nexcept scilab_rl.ScilabRLError as error:\n    print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, text=True, capture_output=True, check=False,
        env=quiet_environment(PYTHONPATH=f"{core_alone}:{ROOT / 'src'}"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert 'pip install "scilab-rl[pandas]"' in done.stdout


@pytest.mark.slow
def test_all_that_reports(core_alone: Path, tmp_path: Path) -> None:
    """Performance tests, films and recorded episodes, with the simulator of the core."""
    folder = tmp_path / "conf" / "performance"
    folder.mkdir(parents=True)
    (folder / "tiny-test.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /algorithm: random\n"
        "env: scilab_rl.testing:TinyBox-v0\neval_after_n_steps: 20\n"
        "performance_testing_conditions:\n  eval_columns: eval/mean_reward\n"
        "  eval_value: -500\n  max_steps: 40\n  margin: 400\n  n_episodes: 5\n"
    )
    short = ("env=FetchReach", "eval_after_n_steps=60", "n_epochs=1", "n_test_rollouts=1", "seed=1")
    for words in (
        ("performance", "tiny-test"),
        ("algorithm=random", *short, "render=record", "render_freq=1"),
        ("play", "last", "--episodes", "1", "--record"),
        ("export", "last", "--episodes", "1"),
        ("doctor",),
    ):
        done = run(core_alone, tmp_path, *words)
        assert done.returncode == 0, (words, done.stderr, done.stdout)
    assert list(tmp_path.glob("data/performance/*.html"))
    assert list(tmp_path.glob("data/last/episodes/*.mp4"))
