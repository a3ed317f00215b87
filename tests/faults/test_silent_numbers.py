"""Success, goals and budgets of unusual tasks: the right number, or one line before the start."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from scilab_rl.cli.main import run_command_line
from scilab_rl.config.compose import compose
from scilab_rl.metrics.store import MetricStore
from scilab_rl.results import RunResult
from scilab_rl.run.run import start_run
from scilab_rl.training.callbacks import EarlyStop, Pruning, RunCallback

from .reporting import MODULE

SHORT = ("n_epochs=1", "eval_after_n_steps=150", "n_test_rollouts=4", "mlflow=0", "seed=1",
         "tuned=false")  # fmt: skip
SUCCESS = (f"env={MODULE}:Reporting-v0", "algorithm=random", *SHORT)
GOALS = (f"env={MODULE}:Effort-v0", "algorithm=cleansac", "algorithm.net_arch=[8]",
         "algorithm.batch_size=16", "algorithm.buffer_size=500", *SHORT)  # fmt: skip
INFO_KEYS = "++algorithm.replay_buffer_kwargs.info_keys"
WHOLE_INFOS = ("algorithm.replay_buffer_class=her",
               "++algorithm.replay_buffer_kwargs.copy_info_dict=true")  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def metrics() -> dict[str, float]:
    return json.loads(Path("data/last/result.json").read_text())["metrics"]


def error_of(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 2) -> str:
    """Return the one line with which a run is refused, having left nothing behind."""
    assert run_command_line(list(arguments)) == code
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error:")]
    assert code != 2 or not list(Path().glob("data/*/*"))
    return line


@pytest.mark.parametrize("case", ["nan", "words", "half", "two"])
def test_what_is_no_truth_value_breaks_the_contract(case: str, capsys: Any) -> None:
    line = error_of(capsys, *SUCCESS, f"+env_kwargs.case={case}", code=1)
    assert "broke its contract in step() at train step 0" in line
    assert "but success must be True or False (0 or 1)" in line


@pytest.mark.parametrize(
    ("case", "rate", "once", "silent"),
    [
        ("array", 1.0, 1.0, None),
        ("float", 1.0, 1.0, None),
        ("end", 0.5, 0.5, None),
        ("rarely", 0.5, 0.5, 2.0),
        ("midway", 0.0, 1.0, 4.0),
    ],
)
def test_the_rate_is_over_all_episodes(
    case: str, rate: float, once: float, silent: float | None, capsys: Any
) -> None:
    assert run_command_line([*SUCCESS, f"+env_kwargs.case={case}"]) == 0
    told = metrics()
    assert told["eval/success_rate"] == rate
    assert told["eval/success_once_rate"] == once
    assert told.get("eval/success_not_reported") == silent
    warned = "evaluation episodes reported no success or failure" in capsys.readouterr().err
    assert warned == (silent is not None)


def test_training_play_and_export_count_silent_episodes_alike(capsys: Any) -> None:
    assert run_command_line([*SUCCESS, "+env_kwargs.case=rarely"]) == 0
    told = metrics()
    assert told["rollout/success_rate"] == pytest.approx(4 / 7)  # of 150 steps
    assert told["rollout/success_not_reported"] == 3
    assert run_command_line(["play", "last", "--episodes", "4"]) == 0
    played = capsys.readouterr().out
    assert "success: 0.50 (95 % interval" in played
    assert "not reported: 2 episodes, counted as not successful" in played
    for per, n_rows in (("episode", 4), ("step", 80)):
        arguments = ["export", "last", "--trials", "--per", per, "--episodes", "4"]
        assert run_command_line(arguments) == 0
        rows = list(csv.DictReader(Path(f"data/last/trials_{per}.csv").open()))
        assert len(rows) == n_rows
        assert sorted(row["success"] for row in rows if row["success"]) == 2 * ["0.0"] + 2 * ["1.0"]
    assert run_command_line(["export", "last", "--training"]) == 0
    rows = list(csv.DictReader(Path("data/last/training.csv").open()))
    assert [row["success"] for row in rows] == 3 * ["True", "False"] + ["True"]


@pytest.mark.parametrize("kind", ["required", "single"])
def test_what_rewards_need_of_infos_is_named(kind: str, capsys: Any) -> None:
    line = error_of(capsys, *GOALS, f"+env_kwargs.kind={kind}")
    assert "compute_reward reads info['effort']" in line
    assert f"add {INFO_KEYS}=[effort]." in line
    assert run_command_line([*GOALS, f"+env_kwargs.kind={kind}", f"{INFO_KEYS}=[effort]"]) == 0


def test_what_rewards_may_use_of_infos_is_a_warning(capsys: Any) -> None:
    assert run_command_line([*GOALS, "+env_kwargs.kind=optional"]) == 0
    assert "info['effort'], which the replay buffer does not keep" in capsys.readouterr().err
    assert run_command_line([*GOALS, "+env_kwargs.kind=optional", f"{INFO_KEYS}=[effort]"]) == 0
    assert "info['effort']" not in capsys.readouterr().err


def test_keys_of_infos_are_checked(capsys: Any) -> None:
    line = error_of(capsys, *GOALS, f"{INFO_KEYS}=[efort]")
    assert "have no 'efort'. Did you mean 'effort'?" in line
    line = error_of(capsys, *GOALS, "+env_kwargs.kind=array")
    assert "use algorithm.replay_buffer_class=her" in line
    line = error_of(capsys, *GOALS, "+env_kwargs.kind=array", f"{INFO_KEYS}=[effort]")
    assert "not one number" in line


def test_stable_baselines3_s_buffer_keeps_whole_infos(capsys: Any) -> None:
    line = error_of(capsys, *GOALS, WHOLE_INFOS[0])
    assert line.endswith(f"add {WHOLE_INFOS[1]}.")
    for kind in ("required", "array"):
        assert run_command_line([*GOALS, *WHOLE_INFOS, f"+env_kwargs.kind={kind}"]) == 0


def test_stable_baselines3_s_buffer_needs_batches(capsys: Any) -> None:
    line = error_of(capsys, *GOALS, *WHOLE_INFOS, "+env_kwargs.kind=single")
    assert "answers for one pair of goals at a time" in line


def test_the_doctor_says_what_the_buffer_says(capsys: Any) -> None:
    run_command_line(["doctor", f"env={MODULE}:Effort-v0", "--steps", "100"])
    table = capsys.readouterr().out
    assert "compute_reward reads effort of the infos" in table
    assert f"{INFO_KEYS}=[effort]" in table
    assert "rewards of a batch\tok" in table


@pytest.mark.parametrize(
    ("size", "more"), [(41, (f"{INFO_KEYS}=[effort]",)), (39, WHOLE_INFOS)], ids=["auto", "her"]
)
def test_a_buffer_holds_a_whole_episode_beside_the_running_one(
    size: int, more: tuple[str, ...], capsys: Any
) -> None:
    goals = [word for word in GOALS if "buffer_size" not in word]
    line = error_of(capsys, *goals, *more, f"algorithm.buffer_size={size}")
    assert "an ended and a running one of 20 steps for each of n_envs=1" in line
    assert f"{size + 1} or more, but it holds {size}." in line
    # Never without an episode to sample from, in more than a hundred steps.
    assert run_command_line([*goals, *more, f"algorithm.buffer_size={size + 1}"]) == 0


def test_runs_that_cannot_learn_are_refused(capsys: Any) -> None:
    reporting = [word for word in SUCCESS if word != "algorithm=random"] + ["+env_kwargs.case=end"]
    line = error_of(capsys, *reporting, "algorithm=ppo")
    assert "its first update comes after step 2048 (n_steps=2048 x n_envs=1)" in line
    assert "the run ends at step 150 (eval_after_n_steps=150 x n_epochs=1)" in line
    line = error_of(capsys, *reporting, "algorithm=sac", "algorithm.learning_starts=149")
    assert "after step 150 (learning_starts=149, train_freq=1, n_envs=1)" in line
    assert "eval_after_n_steps=151 or more" in line
    line = error_of(capsys, *reporting, "algorithm=random", "n_envs=100", "eval_after_n_steps=50")
    assert "shorter than one step of n_envs=100" in line
    arguments = [*reporting, "algorithm=ppo", "require_updates=false"]
    assert run_command_line(arguments) == 0
    assert "ppo would never learn" in capsys.readouterr().err


@pytest.mark.parametrize(("n_epochs", "status"), [(1, "finished"), (2, "solved")])
def test_a_run_is_solved_only_with_epochs_left(n_epochs: int, status: str) -> None:
    words = (*SUCCESS, "+env_kwargs.case=array", "early_stop_last_n=1", f"n_epochs={n_epochs}")
    result = run(*words)
    assert (result.status, result.epochs) == (status, 1)


@pytest.mark.parametrize(("n_epochs", "status"), [(1, "finished"), (2, "pruned")])
def test_a_run_that_somebody_ended_is_not_solved(n_epochs: int, status: str) -> None:
    words = (*SUCCESS, "+env_kwargs.case=array", f"n_epochs={n_epochs}")
    result = run(*words, callbacks=[Pruning(lambda *_: False)])
    assert (result.status, result.epochs) == (status, 1)


def test_epochs_without_the_metric_are_no_evidence_for_an_early_stop() -> None:
    """Two of three epochs measured a reward of 1: that is not a threshold held for two epochs."""
    store = MetricStore()
    early_stop = EarlyStop(store, "eval/x", threshold=1.0, last_n=2)
    reasons = []
    for step, values in enumerate([{"eval/x": 1.0}, {}, {"eval/x": 1.0}, {"eval/x": 1.0}]):
        store.append(step, values)
        reasons.append(early_stop.on_epoch(step, step + 1, values))
    assert reasons == [None, None, None, "solved"]


def run(*words: str, callbacks: Sequence[RunCallback] = ()) -> RunResult:
    Path("conf").mkdir()  # Hydra warns where a project folder has none
    cfg = compose(list(words))
    return start_run(cfg, callbacks=callbacks)
