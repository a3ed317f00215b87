"""``scilab-rl goals``: from a run to a page with everything in it."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from scilab_rl.cli.main import run_command_line
from scilab_rl.config.compose import compose
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.run import start_run

TRAIN = [
    "env=scilab_rl.testing:TinyReach-v0", "algorithm=cleansac", "n_epochs=2", "seed=3", "mlflow=0",
    "eval_after_n_steps=60", "n_test_rollouts=2", "tuned=false", "algorithm.net_arch=[8]",
    "algorithm.batch_size=8", "algorithm.learning_starts=20", "++tracking.console.enabled=false",
    "keep_policies=1", "save_model_freq=100",
]  # fmt: skip


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    return RunDirectory(Path(start_run(compose(TRAIN)).run_dir).resolve())


def test_a_run_becomes_a_page_tables_and_episodes(run, capsys):
    command = ["goals", "last", "--cells", "4,4", "--episodes", "1", "--record", "1"]
    assert run_command_line([*command, "--checkpoint", "all"]) == 0
    assert "success over the goal space: " in capsys.readouterr().out
    page = (run / "goals" / "goals.html").read_text()
    # All four policies, in the order of training, in one scale.
    steps = [int(step) for step in re.findall(r'data-name="[a-z_0-9]+, after (\d+) steps"', page)]
    assert len(steps) == 4 and steps == sorted(steps) and set(steps) == {60, 120}
    assert 'type="range"' in page and "ms of CPU time for" in page
    assert "the replay buffer of the training, in the checkpoint step_0000000" in page
    assert "relabels 80 %" in page and "<script src" not in page and "http" not in page
    link = re.search(r'href="(\.\./episodes/goals_001\.html)">goals_001 \(', page)
    assert link and (run / "goals" / link[1]).is_file()
    with (run / "goals" / "goals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 16 and {row["episodes"] for row in rows} == {"1"}
    assert (run / "goals" / "goals.png").stat().st_size > 10_000
    assert (run / "goals" / "episodes.csv").read_text().count("\n") == 17


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["goals", "agent:CartPole"], "CartPole-v1 has no goals"),
        (["goals", "agent:Reach1DOF", "--cells", "x"], "whole numbers such as 15,15"),
        (["goals", "agent:FetchPsh"], "Did you mean 'FetchPush'"),
    ],
)
def test_what_makes_no_sense_is_one_line(arguments, message, capsys):
    assert run_command_line(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") <= 1
