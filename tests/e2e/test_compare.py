"""An experiment from the command line: train missing runs, compare, export."""

from __future__ import annotations

import csv
from pathlib import Path

from tests.e2e.commands import QUICK, TINY, scilab_rl

SHORT = (TINY, "eval_after_n_steps=60", "n_epochs=2", "n_test_rollouts=2", "mlflow=0")


def n_runs(folder: Path) -> int:
    return len(list((folder / "data").glob("*-*-*/*/config.yaml")))


def test_an_experiment_trains_what_is_missing_and_compares(tmp_path: Path) -> None:
    words = ("experiment", "base=random", "variant=random2:random,n_envs=2", *SHORT)
    done = scilab_rl(*words, "seeds=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert n_runs(tmp_path) == 4
    assert "random2 and random do not differ significantly with 2 runs each" in done.stdout
    page = tmp_path / "data" / "comparisons" / "random-vs-random2" / "comparison.html"
    assert page.stat().st_size > 10_000

    more = scilab_rl(*words, "seeds=3", cwd=tmp_path)
    assert "random: 2 of 3 runs exist; training 1." in more.stderr
    assert n_runs(tmp_path) == 6

    compared = scilab_rl("compare", "all=random", "one=*-s1-*", cwd=tmp_path)
    assert compared.returncode == 0, compared.stderr
    assert "n_envs differ" in compared.stderr  # both groups of the experiment are called random


def test_wrong_words_are_named(tmp_path: Path) -> None:
    done = scilab_rl("experiment", "base=random", *SHORT, cwd=tmp_path)
    assert (done.returncode, "at least one variant" in done.stderr) == (2, True)
    done = scilab_rl("compare", "sac", "td3", cwd=tmp_path)
    assert (done.returncode, "'sac' is not a study, group, algorithm" in done.stderr) == (2, True)


def test_trials_are_exported_as_a_tidy_table(tmp_path: Path) -> None:
    quick = [word for word in QUICK if not word.startswith("n_epochs")]
    quick += ["n_epochs=1", "algorithm.learning_starts=50"]
    trained = scilab_rl("algorithm=cleansac", TINY, *quick, cwd=tmp_path)
    assert trained.returncode == 0, trained.stderr
    done = scilab_rl("export", "last", "--trials", "--episodes=3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    path = tmp_path / "data" / "last" / "trials_step.csv"
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert {row["episode"] for row in rows} == {"0", "1", "2"}
    assert {"run", "action_0", "reward", "value", "critic_variance", "td_error", "success"} <= {
        *rows[0]
    }
    episodes = scilab_rl(
        "export", "last", "--trials", "--per=episode", "--episodes=3", "--output=out/e.csv",
        cwd=tmp_path,
    )  # fmt: skip
    assert episodes.returncode == 0, episodes.stderr
    assert len((tmp_path / "out" / "e.csv").read_text().splitlines()) == 4
    training = scilab_rl("export", "last", "--training", cwd=tmp_path)
    assert training.returncode == 0, training.stderr
    assert "reward" in (tmp_path / "data/last/training.csv").read_text().splitlines()[0]
