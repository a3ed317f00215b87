"""Studies from the command line, with real trainings of some seconds."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from pathlib import Path

import psutil
import pytest

from .commands import ROOT, TINY, command, config_of, quiet_environment, scilab_rl

TINY_RUNS = (
    "algorithm=sac", TINY, "n_epochs=2", "eval_after_n_steps=50", "n_test_rollouts=2", "mlflow=0",
    "algorithm.buffer_size=1000", "algorithm.learning_starts=1000", "require_updates=false",
)  # fmt: skip
GAMMA = "algorithm.gamma=interval(0.9,0.99)"


def study_of(folder: Path, name: str) -> Path:
    return folder / "data" / "studies" / name


def runs_of(study: Path) -> list:
    from scilab_rl.search.storage import open_study

    return open_study(study).runs()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small study, shared by the tests that only look at it."""
    folder = tmp_path_factory.mktemp("project")
    done = scilab_rl(
        *TINY_RUNS, GAMMA, "--multirun", "hydra.sweeper.max_trials=4",
        "hydra.sweeper.min_trials_per_param=2", "hydra.sweeper.study_name=mine", cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "score with new seeds" in done.stdout
    return folder


def test_leaves_a_whole_report(finished: Path) -> None:
    study = study_of(finished, "mine")
    page = (study / "report.html").read_text()
    assert 'class="forest"' in page and "What was never tried" in page
    assert "://" not in page  # pictures may contain any letters
    assert (study / "configurations.csv").read_text().startswith("configuration,algorithm.gamma")
    runs = runs_of(study)
    assert [run.state for run in runs] == ["complete"] * 6
    first = config_of(finished / runs[0].run_dir)
    assert (first["seed"], first["group"]) == (runs[0].seed, "mine")
    assert first["algorithm"]["gamma"] == 0.99  # what the configuration has comes first
    rows = json.loads((finished / runs[0].run_dir / "result.json").read_text())
    assert rows["metrics"]["eval/success_rate"] == runs[0].values[-1]


def test_the_same_command_repeats_nothing(finished: Path) -> None:
    before = runs_of(study_of(finished, "mine"))
    done = scilab_rl(
        *TINY_RUNS, GAMMA, "--multirun", "hydra.sweeper.max_trials=4",
        "hydra.sweeper.min_trials_per_param=2", "hydra.sweeper.study_name=mine", cwd=finished,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert runs_of(study_of(finished, "mine")) == before


def test_f20_another_search_space_is_refused(finished: Path) -> None:
    done = scilab_rl(
        *TINY_RUNS, "algorithm.gamma=interval(0.5,0.99)", "--multirun",
        "hydra.sweeper.min_trials_per_param=2", "hydra.sweeper.study_name=mine", cwd=finished,
    )  # fmt: skip
    assert done.returncode == 2
    assert "allow_space_change=true" in done.stderr


def test_trains_with_the_winner(finished: Path) -> None:
    winner = json.loads((study_of(finished, "mine") / "winner.json").read_text())["overrides"][-1]
    done = scilab_rl("+from_study=mine", "seed=3", "n_epochs=1", cwd=finished)
    assert done.returncode == 0, done.stderr
    config = config_of((finished / "data" / "last").resolve())
    assert winner == f"++algorithm.gamma={config['algorithm']['gamma']}"
    assert (config["seed"], config["n_epochs"]) == (3, 1)


def test_dashboard_opens_on_the_loopback_only(finished: Path) -> None:
    pytest.importorskip("optuna_dashboard")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        command("study", "mine", "--dashboard", "--port", str(port)),
        cwd=finished, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env=quiet_environment(),
    )  # fmt: skip
    try:
        page = fetch(f"http://127.0.0.1:{port}/api/studies", process)
        addresses = {
            connection.laddr.ip
            for connection in psutil.Process(process.pid).net_connections()
            if connection.status == psutil.CONN_LISTEN
        }
    finally:
        process.terminate()
        process.wait(20)
    assert [study["study_name"] for study in json.loads(page)["study_summaries"]] == ["mine"]
    assert addresses == {"127.0.0.1"}


def fetch(url: str, process: subprocess.Popen) -> str:
    """Return what a server says as soon as it is there."""
    deadline = time.monotonic() + 60
    while True:
        try:
            return urllib.request.urlopen(url, timeout=5).read().decode()
        except OSError:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.2)


@pytest.mark.slow
def test_submitit_finds_the_same_as_this_machine(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    found = []
    for launcher in ("local", "submitit_local"):
        done = scilab_rl(
            *TINY_RUNS, GAMMA, "--multirun", "hydra.sweeper.max_trials=2", "hydra.sweeper.seed=5",
            "hydra.sweeper.min_trials_per_param=1", "hydra.sweeper.n_final_runs=1",
            f"hydra.sweeper.study_name={launcher}", f"hydra/launcher={launcher}", cwd=tmp_path,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        runs = runs_of(study_of(tmp_path, launcher))
        found.append([(run.seed, run.values, run.scores) for run in runs])
    assert found[0] == found[1]


@pytest.mark.slow
def test_grid_by_submitit_runs_each_combination_once_and_says_what_failed(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    done = scilab_rl(
        *TINY_RUNS, "algorithm.learning_starts=10", "algorithm.batch_size=16", "seed=1",
        "algorithm.learning_rate=0.001,1e30", "--multirun", "hydra/launcher=submitit_local",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "1 of 2 runs failed" in done.stderr
    assert "): FAILED: " in done.stderr
    results = [json.loads(p.read_text())["status"] for p in tmp_path.glob("data/*/*/result.json")]
    assert sorted(results) == ["failed", "finished"]


@pytest.mark.slow
def test_study_command_shows_and_keeps_the_winner(finished: Path) -> None:
    shown = scilab_rl("study", "mine", "--json", "--write-tuned", cwd=finished)
    assert shown.returncode == 0, shown.stderr
    found = json.loads(shown.stdout)
    assert found["configurations"][0]["verdict"] == "winner"
    kept = finished / "conf" / "tuned_values" / "scilab_rl.testing:TinyReach" / "sac.yaml"
    assert "gamma" in kept.read_text()
    again = scilab_rl("study", "mine", "--write-tuned", cwd=finished)
    assert (again.returncode, "by hand" in again.stderr) == (2, True)
    listed = scilab_rl("study", cwd=finished)
    assert "mine" in listed.stdout
    shutil.rmtree(finished / "conf")


def test_runs_in_another_version_of_the_environment_are_told(finished: Path) -> None:
    first = finished / runs_of(study_of(finished, "mine"))[0].run_dir / "provenance.json"
    kept = first.read_text()
    first.write_text(json.dumps(json.loads(kept) | {"fingerprint": "0123456789abcdef"}))
    shown = scilab_rl("study", "mine", cwd=finished)
    first.write_text(kept)
    assert shown.returncode == 0, shown.stderr
    assert "did not behave the same in these runs" in shown.stderr
    assert "did not behave" not in scilab_rl("study", "mine", cwd=finished).stderr


def test_f12_crashed_runs_give_exit_code_3_and_the_others_go_on(tmp_path: Path) -> None:
    done = scilab_rl(
        *TINY_RUNS, "algorithm.learning_starts=10", "algorithm.batch_size=16",
        "algorithm.learning_rate=0.001,1e30", "--multirun", "hydra.sweeper.max_trials=4",
        "hydra.sweeper.min_trials_per_param=2", "hydra.sweeper.study_name=broken", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert "runs failed, first with:" in done.stderr
    assert "algorithm.learning_rate=0.001" in done.stdout


@pytest.mark.slow
def test_grid_runs_each_combination_once_and_says_what_failed(tmp_path: Path) -> None:
    done = scilab_rl(
        *TINY_RUNS, "algorithm.learning_starts=10", "algorithm.batch_size=16", "seed=1",
        "algorithm.learning_rate=0.001,1e30", "--multirun", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "1 of 2 runs failed" in done.stderr
    results = [json.loads(p.read_text())["status"] for p in tmp_path.glob("data/*/*/result.json")]
    assert {"failed", "finished"} == set(results)


def test_paper_s_search_runs_unchanged(tmp_path: Path) -> None:
    """Appendix A.2, from the project folder, with smaller numbers on the command line."""
    shutil.copytree(ROOT / "conf", tmp_path / "conf")
    for name in ("custom_algorithms", "custom_envs"):
        shutil.copytree(ROOT / "src" / name, tmp_path / "src" / name)
    done = scilab_rl(
        "+performance=FetchPush/sac_var-opti", "--multirun", "hydra.sweeper.max_trials=2",
        "hydra.sweeper.min_trials_per_param=1", "hydra.sweeper.n_final_runs=1", "n_epochs=1",
        "eval_after_n_steps=60", "n_test_rollouts=1", "algorithm.buffer_size=1000", "mlflow=0",
        "require_updates=false",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (study_of(tmp_path, "sac_var_FetchPush") / "report.html").is_file()
    assert len(runs_of(study_of(tmp_path, "sac_var_FetchPush"))) == 3


@pytest.mark.slow
def test_ctrl_c_lets_the_running_trainings_end(tmp_path: Path) -> None:
    process = subprocess.Popen(
        command(
            *TINY_RUNS, GAMMA, "--multirun", "hydra.sweeper.max_trials=100",
            "hydra.sweeper.study_name=long",
        ),
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=quiet_environment(), start_new_session=True,
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if "done after" in line:
            break
    os.killpg(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "the same command continues it" in errors
    assert "report:" in output
    assert {run.state for run in runs_of(study_of(tmp_path, "long"))} == {"complete"}
