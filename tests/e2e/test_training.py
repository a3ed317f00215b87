"""A run from the command line, and everything it leaves behind."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from .commands import (
    QUICK,
    ROOT,
    TINY,
    command,
    config_of,
    last_run,
    quiet_environment,
    scilab_rl,
    untimed_rows,
)


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One complete run, shared by the tests that only look at it."""
    folder = tmp_path_factory.mktemp("project")
    done = scilab_rl("algorithm=sac", TINY, *QUICK, "info=a note", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_leaves_a_complete_run_directory(finished_run: Path) -> None:
    run = last_run(finished_run)
    names = {path.name for path in run.iterdir()}
    assert names >= {
        "config.yaml", "provenance.json", "metrics.csv", "metrics.jsonl", "train.log",
        "result.json", "rl_model_best", "rl_model_finished",
    }  # fmt: skip
    assert config_of(run)["seed"] == 7
    assert config_of(run)["info"] == "a note"
    provenance = json.loads((run / "provenance.json").read_text())
    assert f"{TINY}" in provenance["overrides"]
    assert len(provenance["fingerprint"]) == 16
    assert provenance["versions"]["stable_baselines3"].startswith("2.")


def test_result_matches_the_metrics(finished_run: Path) -> None:
    run = last_run(finished_run)
    result = json.loads((run / "result.json").read_text())
    rows = (run / "metrics.csv").read_text().splitlines()
    header, last = rows[0].split(","), rows[-1].split(",")
    assert result["status"] == "finished"
    assert (result["epochs"], result["steps"], len(rows)) == (3, 300, 4)
    assert result["score"] == float(last[header.index("eval/success_rate")])
    assert {"rollout/ep_rew_mean", "train/rollout_rewards_step", "time/fps"} <= set(header)


def test_nothing_is_written_outside_the_run(finished_run: Path) -> None:
    assert [path.name for path in finished_run.iterdir()] == ["data"]


def test_same_seed_gives_the_same_metrics_and_weights(finished_run: Path) -> None:
    first = last_run(finished_run)
    done = scilab_rl("algorithm=sac", TINY, *QUICK, cwd=finished_run)
    assert done.returncode == 0, done.stderr
    second = last_run(finished_run)
    assert second != first
    assert untimed_rows(second) == untimed_rows(first)
    assert _weights(second) == _weights(first)


def test_another_seed_gives_other_metrics_and_zero_draws_one(finished_run: Path) -> None:
    first = last_run(finished_run)
    arguments = [argument for argument in QUICK if not argument.startswith("seed")]
    assert scilab_rl("algorithm=sac", TINY, *arguments, cwd=finished_run).returncode == 0
    second = last_run(finished_run)
    assert config_of(second)["seed"] not in (0, 7)
    assert untimed_rows(second) != untimed_rows(first)


def test_play_reports_success_with_an_interval(finished_run: Path) -> None:
    done = scilab_rl("play", "last", "--episodes", "5", cwd=finished_run)
    assert done.returncode == 0, done.stderr
    assert "episodes: 5" in done.stdout
    assert "95 % interval" in done.stdout


def test_restored_policy_acts_as_the_saved_one(finished_run: Path) -> None:
    policy = last_run(finished_run) / "rl_model_finished"
    wanted = json.loads((last_run(finished_run) / "result.json").read_text())
    done = scilab_rl(
        "algorithm=sac", TINY, *QUICK, "n_epochs=1", "algorithm.learning_starts=1000",
        "require_updates=false",
        f"+restore_policy={policy}", cwd=finished_run,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    # No update happens before learning_starts: the weights are the restored ones.
    assert _weights(last_run(finished_run)) == _weights(Path(wanted["run_dir"]), finished_run)


@pytest.mark.parametrize("algorithm", ["sac", "cleansac", "ppo"])
def test_killed_and_resumed_equals_uninterrupted(algorithm: str, tmp_path: Path) -> None:
    """Killed in the middle of an epoch: weights and metrics end the same, bit for bit."""
    arguments = [f"algorithm={algorithm}", TINY, "n_envs=2", *QUICK, "save_model_freq=60"]
    if algorithm == "ppo":
        arguments = [a for a in arguments if "buffer_size" not in a] + ["algorithm.n_steps=32"]
    assert scilab_rl(*arguments, cwd=tmp_path).returncode == 0
    uninterrupted = last_run(tmp_path)
    _start_and_signal(arguments, tmp_path, signal.SIGKILL)
    killed = last_run(tmp_path)
    assert killed != uninterrupted
    assert json.loads((killed / "result.json").read_text())["status"] == "running"
    assert "crashed" in scilab_rl("runs", "--last", "1", cwd=tmp_path).stdout
    resumed = scilab_rl("resume", "last", cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert untimed_rows(killed) == untimed_rows(uninterrupted)
    assert _weights(killed) == _weights(uninterrupted)


@pytest.mark.parametrize("algorithm", ["cleansac", pytest.param("ppo", marks=pytest.mark.slow)])
def test_a_finished_run_trains_on_as_if_it_had_been_longer(algorithm: str, tmp_path: Path) -> None:
    """Its last rollout is repeated from its beginning; all that follows is the same bit for bit."""
    arguments = [f"algorithm={algorithm}", TINY, *QUICK, "early_stop_threshold=2"]
    if algorithm == "ppo":
        arguments = [a for a in arguments if "buffer_size" not in a] + ["algorithm.n_steps=32"]
    assert scilab_rl(*arguments, cwd=tmp_path).returncode == 0
    longer = last_run(tmp_path)
    short = [*arguments, "n_epochs=2", "save_model_freq=100000"]
    assert scilab_rl(*short, cwd=tmp_path).returncode == 0
    resumed = scilab_rl("resume", "last", "n_epochs=+1", cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert untimed_rows(last_run(tmp_path)) == untimed_rows(longer)
    assert _weights(last_run(tmp_path)) == _weights(longer)
    assert (last_run(tmp_path) / "curve.png").stat().st_size > 5000


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_graceful_shutdown_saves_a_checkpoint(
    number: signal.Signals, code: int, tmp_path: Path
) -> None:
    arguments = ["algorithm=sac", TINY, *QUICK, "n_epochs=1000"]
    process = _start_and_signal(arguments, tmp_path, number)
    assert process.returncode == code
    assert "Resume with: scilab-rl resume" in process.stderr
    result = json.loads((last_run(tmp_path) / "result.json").read_text())
    assert result["status"] == "interrupted"
    epochs = result["epochs"]
    resumed = scilab_rl("resume", "last", f"n_epochs={epochs + 1}", cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    result = json.loads((last_run(tmp_path) / "result.json").read_text())
    assert (result["status"], result["epochs"]) == ("finished", epochs + 1)


def test_failing_run_says_what_and_keeps_the_traceback(tmp_path: Path) -> None:
    done = scilab_rl("algorithm=sac", TINY, *QUICK, "algorithm.learning_rate=1e30", cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("error:")
    run = last_run(tmp_path)
    result = json.loads((run / "result.json").read_text())
    assert (result["status"], result["score"]) == ("failed", None)
    assert "Traceback" in (run / "error.log").read_text()


def test_runs_with_every_tracker_broken(tmp_path: Path) -> None:
    """Mirrors that cannot write change nothing in the run's own files."""
    good = scilab_rl("algorithm=sac", TINY, *QUICK, cwd=tmp_path)
    assert good.returncode == 0
    expected = untimed_rows(last_run(tmp_path))
    broken = scilab_rl(
        "algorithm=sac", TINY, *[a for a in QUICK if a != "mlflow=0"], "mlflow=1",
        "tracking.mlflow.tracking_uri=sqlite:////dev/null/mlflow.db",
        "wandb=1", "tracking.wandb.mode=online", "tensorboard=0",
        cwd=tmp_path, WANDB_BASE_URL="http://127.0.0.1:9", WANDB_API_KEY="x" * 40,
        WANDB_INIT_TIMEOUT="3",
    )  # fmt: skip
    assert broken.returncode == 0, broken.stderr
    assert "mlflow is switched off for this run" in broken.stderr
    assert untimed_rows(last_run(tmp_path)) == expected


def test_fetch_reach_runs_with_a_paper_era_id(tmp_path: Path) -> None:
    """The real simulator, with the id and the keys that the paper's documentation prints."""
    done = scilab_rl(
        "algorithm=sac", "env=FetchReach-v2", "wandb=0", "n_epochs=1", "eval_after_n_steps=60",
        "n_test_rollouts=1", "seed=1", "mlflow=0", "+env_kwargs.reward_type=dense",
        "algorithm.buffer_size=1000", "algorithm.learning_starts=50", "render=record",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "FetchReach-v2 is not available any more; using FetchReach-v4." in done.stderr
    assert config_of(last_run(tmp_path))["env"] == "FetchReach-v4"


def test_commands_start_without_heavy_imports() -> None:
    done = subprocess.run(
        command("--help"), cwd=ROOT, capture_output=True, text=True, check=True,
        env=quiet_environment(PYTHONPROFILEIMPORTTIME="1"),
    )  # fmt: skip
    imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines()}
    heavy = {"torch", "gymnasium", "mujoco", "stable_baselines3", "mlflow", "wandb", "matplotlib"}
    assert not heavy & imported
    assert "n_epochs" in done.stdout


def _start_and_signal(
    arguments: list[str], folder: Path, number: signal.Signals
) -> subprocess.CompletedProcess:
    """Start a run, wait for its second epoch, and send a signal in the middle of the third."""
    before = set(folder.glob("data/*-*-*/*"))
    process = subprocess.Popen(
        command(*arguments),
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=quiet_environment(),
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        new = [run for run in folder.glob("data/*-*-*/*") if run not in before and run.is_dir()]
        if new and (new[0] / "metrics.csv").is_file():
            if len((new[0] / "metrics.csv").read_text().splitlines()) >= 3:
                break
        time.sleep(0.005)
    os.kill(process.pid, number)
    _, errors = process.communicate(timeout=30)
    return subprocess.CompletedProcess(arguments, process.returncode, stderr=errors)


def _weights(run: Path, root: Path = Path()) -> str:
    path = root / run / "rl_model_finished" / "tensors.safetensors"
    return hashlib.sha256(path.read_bytes()).hexdigest()
