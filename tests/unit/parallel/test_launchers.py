"""Studies whose runs are jobs: on Ray, and by submitit here and on a stand-in for SLURM."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from scilab_rl.errors import ConfigError, ScilabRLError
from scilab_rl.parallel import job
from scilab_rl.parallel.jobs import JobPool
from scilab_rl.parallel.launchers import open_pool
from scilab_rl.parallel.schedulers import RayScheduler, SubmititScheduler
from scilab_rl.parallel.worker import Message, Task
from scilab_rl.search.runs import COMPLETE, FAILED, PRUNED
from tests.unit.search import toy, toy_worker

ROOT = Path(__file__).parents[3]
STUB = Path(__file__).parent / "slurm_stub"


@pytest.fixture
def submitit(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.fixture
def slurm(submitit: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands that keep each job as a process; returns the folder where they note what came."""
    monkeypatch.setenv("PATH", f"{STUB}:{os.environ['PATH']}")
    notes = tmp_path / "slurm"
    notes.mkdir()
    monkeypatch.setenv("SLURM_STUB_NOTES", str(notes))
    return notes


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A Ray cluster with two nodes of one core each, both on this machine."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setattr("ray._private.ray_constants.ENABLE_RAY_CLUSTER", False)  # the loopback only
        patch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        node = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "include_dashboard": False}
        made = Cluster(initialize_head=True, head_node_args=node)
        made.add_node(num_cpus=1, node_ip_address="127.0.0.1")
        yield made.address
        made.shutdown()


def on_ray(address: str):
    return lambda directory: JobPool(
        2, directory / "jobs", RayScheduler(address), function=toy_worker.train_on_ray
    )


def by_submitit(cluster: str = "local", **parameters):
    def open_jobs(directory: Path) -> JobPool:
        scheduler = SubmititScheduler(cluster, directory / "submitit", parameters)
        return JobPool(2, directory / "jobs", scheduler, function=toy_worker.train)

    return open_jobs


def outcome(study) -> list[tuple]:
    """What a study has found, in an order that does not depend on which run ended first."""
    settings = study.storage.configurations()
    return sorted(
        (settings[run.trial]["x"], run.repeat, run.seed, run.scores) for run in study.runs
    )


HALVES = toy.SearchSpace([toy.Parameter("++x", "categorical", choices=(0.25, 0.5))])
INTEGER = {"space": HALVES, "max_trials": 4, "max_trials_per_param": 2, "pruner": "none"}


@pytest.mark.slow
def test_ray_cluster_of_two_nodes_finds_the_same_as_this_machine(
    cluster: str, tmp_path: Path
) -> None:
    ours = toy.run(tmp_path / "here", **INTEGER)
    theirs = toy.run(tmp_path / "there", open_pool=on_ray(cluster), **INTEGER)
    assert outcome(theirs) == outcome(ours)
    nodes = {path.read_text() for path in (tmp_path / "there").rglob("node")}
    assert len(nodes) == 2, "both nodes have trained"


@pytest.mark.slow
def test_ray_task_that_dies_is_repeated(cluster: str, tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", "die=kill", f"once={tmp_path / 'died'}", open_pool=on_ray(cluster),
        max_trials=4,
    )  # fmt: skip
    assert {run.state for run in study.runs} == {COMPLETE}
    assert [run.attempt for run in study.runs].count(1) == 1


def test_processes_by_submitit_find_the_same_as_this_machine(
    submitit: None, tmp_path: Path
) -> None:
    ours = toy.run(tmp_path / "here", **INTEGER)
    theirs = toy.run(tmp_path / "there", open_pool=by_submitit(timeout_min=5), **INTEGER)
    assert outcome(theirs) == outcome(ours)


def test_slurm_gets_the_script_that_was_asked_for(slurm: Path, tmp_path: Path) -> None:
    ours = toy.run(tmp_path / "here", **INTEGER)
    asked = {
        "name": "my-study", "cpus_per_task": 3, "mem_gb": 8, "timeout_min": 90,
        "partition": "short", "setup": ["echo prepared"],
    }  # fmt: skip
    theirs = toy.run(tmp_path / "there", open_pool=by_submitit("slurm", **asked), **INTEGER)
    assert outcome(theirs) == outcome(ours)
    scripts = [path.read_text() for path in sorted(slurm.glob("*.script"))]
    arrays = [line for script in scripts for line in script.splitlines() if "--array" in line]
    # The first two runs begin together; which later ones do depends on when the earlier ones end.
    assert arrays and set(arrays) == {"#SBATCH --array=0-1%2"}
    assert len(scripts) == len(theirs.runs) - len(arrays)
    for line in (
        "#SBATCH --job-name=my-study", "#SBATCH --cpus-per-task=3", "#SBATCH --mem=8GB",
        "#SBATCH --time=90", "#SBATCH --partition=short", "echo prepared",
    ):  # fmt: skip
        assert all(line in script.splitlines() for script in scripts), line
    assert all("-m submitit.core._submit" in script for script in scripts)


@pytest.mark.slow
def test_slurm_runs_are_pruned_by_their_intermediate_values(slurm: Path, tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", open_pool=by_submitit("slurm"), max_trials=20, pruner="median",
        pruner_warmup_epochs=1,
    )  # fmt: skip
    pruned = [run for run in study.runs if run.state == PRUNED]
    assert pruned
    assert any(1 < len(run.values) < toy_worker.N_EPOCHS for run in pruned)


@pytest.mark.slow
def test_late_job_is_cancelled(slurm: Path, tmp_path: Path) -> None:
    study = toy.run(
        tmp_path / "study", "die=hang", "where=0.25", open_pool=by_submitit("slurm"),
        space=toy.CHOICES, trial_timeout=1, max_trials=10,
    )  # fmt: skip
    late = [run for run in study.runs if run.state == FAILED]
    assert late
    assert all("trial_timeout" in run.error for run in late)
    assert len(list(slurm.glob("*.cancelled"))) == len(late)


@pytest.mark.parametrize("by_signal", [False, True])
def test_preempted_job_is_started_again_by_slurm_and_continues(
    by_signal: bool, slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SLURM ends it at once, or warns it with a signal; the study sees one attempt."""
    monkeypatch.setenv("SLURM_STUB_REQUEUE", "1")
    hit = tmp_path / "preempted"
    die = "die=hang" if by_signal else "die=kill"
    if by_signal:
        threading.Thread(target=warn_of_preemption, args=(hit,), daemon=True).start()
    study = toy.run(
        tmp_path / "study", die, f"once={hit}", open_pool=by_submitit("slurm"), max_trials=4
    )
    assert {run.state for run in study.runs} == {COMPLETE}
    assert {run.attempt for run in study.runs} == {0}
    assert len(list(slurm.glob("*.pid"))) == len(study.runs), "no job was submitted a second time"
    assert len(list(slurm.glob("*.requeued"))) == int(by_signal)
    said = [job.read_messages(path.parent, 0)[0] for path in tmp_path.rglob(job.MESSAGES)]
    starts = [[m.content for m in messages if m.kind == "started"] for messages in said]
    (twice,) = [contents for contents in starts if len(contents) == 2]
    assert [content["continues"] for content in twice] == ["", twice[0]["run_dir"]]


def warn_of_preemption(hit: Path) -> None:
    """Send SLURM's signal to the job that hangs."""
    while not (hit.exists() and hit.read_text()):
        time.sleep(0.1)
    os.kill(int(hit.read_text()), signal.SIGUSR2)


def test_restarted_job_hears_the_answers_to_its_own_questions(tmp_path: Path) -> None:
    first = job.FileChannel(tmp_path)
    first.send(Message("started", {"run_dir": "runs/a"}))
    first.send(Message("evaluated", {"epoch": 1}))
    with (tmp_path / job.MESSAGES).open("a") as file:
        file.write('{"kind": "eval')  # its end has torn the line
    again = job.FileChannel(tmp_path)
    again.send(Message("evaluated", {"epoch": 2}))
    job.write_answer(tmp_path, go_on=False)  # to the first question
    job.write_answer(tmp_path, go_on=True)
    assert again.recv() is True
    messages, _ = job.read_messages(tmp_path, 0)
    assert [message.content.get("epoch") for message in messages] == [None, 1, 2]


def test_job_that_has_said_its_last_word_trains_nothing_again(tmp_path: Path) -> None:
    folder = tmp_path / "run-0"
    job.write_task(folder, Task(("++x=0.5", "seed=1"), "eval/success_rate"), 1, toy_worker.train)
    (tmp_path / job.ALIVE).touch()
    job.FileChannel(folder).send(Message("finished", {}))
    job.run(str(folder))
    assert [message.kind for message in job.read_messages(folder, 0)[0]] == ["finished"]


def test_jobs_that_slurm_refuses_are_told_in_its_words(slurm: Path, tmp_path: Path) -> None:
    open_jobs = by_submitit("slurm", partition="no-such-partition")
    with pytest.raises(ScilabRLError, match=r"SLURM does not take the jobs.*invalid partition"):
        toy.run(tmp_path / "study", open_pool=open_jobs, max_trials=4)


def test_run_whose_study_has_gone_ends_at_its_next_evaluation(tmp_path: Path) -> None:
    folder = tmp_path / "run-0"
    folder.mkdir()
    started = time.monotonic()
    assert job.FileChannel(folder, patience=0.3).recv() is False
    assert time.monotonic() - started < 5


def test_run_waits_as_long_as_its_study_gives_signs(tmp_path: Path) -> None:
    folder = tmp_path / "run-0"
    folder.mkdir()

    def be_slow() -> None:
        for _ in range(8):
            time.sleep(0.15)
            (tmp_path / job.ALIVE).touch()
        job.write_answer(folder, go_on=True)

    threading.Thread(target=be_slow).start()
    assert job.FileChannel(folder, patience=0.6).recv() is True


def test_message_counts_when_its_line_is_whole(tmp_path: Path) -> None:
    job.FileChannel(tmp_path).send(Message("evaluated", {"epoch": 1, "value": 0.5}))
    whole = (tmp_path / job.MESSAGES).read_bytes()
    for cut in range(len(whole)):
        (tmp_path / job.MESSAGES).write_bytes(whole[:cut])
        assert job.read_messages(tmp_path, 0) == ([], 0)
    (tmp_path / job.MESSAGES).write_bytes(whole + whole[:9])
    messages, position = job.read_messages(tmp_path, 0)
    assert [message.content["value"] for message in messages] == [0.5]
    assert job.read_messages(tmp_path, position) == ([], position)


def test_job_that_waited_longer_than_its_study_lived_trains_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "run-0"
    job.write_task(folder, Task(("++x=0.5", "seed=1"), "eval/success_rate"), 1, toy_worker.train)
    job.run(str(folder))
    assert job.read_messages(folder, 0) == ([], 0)


def test_launcher_of_somebody_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="submitit_slurm"):
        open_pool({"_target_": "hydra_plugins.x.JoblibLauncher"}, 2, tmp_path)


def test_ray_that_is_not_there_is_said_at_once() -> None:
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match="no Ray cluster answers"):
        RayScheduler("127.0.0.1:1")


def test_slurm_that_is_not_there_is_said(submitit: None, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="srun"):
        SubmititScheduler("slurm", tmp_path, {})
