"""A file of one's own that chooses a launcher: the one of the page on SLURM, as it stands there."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from scilab_rl.search.runs import COMPLETE

from ..docs.pages import DOCS, blocks_of
from .commands import QUICK, TINY, scilab_rl
from .test_hyperopt import runs_of, study_of

STUB = Path(__file__).parents[1] / "unit" / "parallel" / "slurm_stub"
FILE = "+performance=my_cluster"
SHORT = (TINY, "algorithm=sac", *QUICK, "n_epochs=1", "algorithm.learning_starts=10")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with the page's file."""
    (block,) = (b for b in blocks_of(DOCS / "howto" / "slurm.md") if b.language == "yaml")
    assert block.title is not None
    (tmp_path / block.title).parent.mkdir(parents=True)
    (tmp_path / block.title).write_text(block.text)
    return tmp_path


@pytest.fixture(params=["submitit_slurm", "submitit_local"])
def cluster(request: pytest.FixtureRequest, project: Path) -> dict[str, str]:
    """The environment of a command: with the stand-in for SLURM, or with submitit's own jobs."""
    pytest.importorskip("submitit")
    notes = project / "slurm"
    notes.mkdir()
    file = project / "conf" / "performance" / "my_cluster.yaml"
    file.write_text(file.read_text().replace("submitit_slurm", request.param))
    return {"PATH": f"{STUB}:{os.environ['PATH']}", "SLURM_STUB_NOTES": str(notes)}


def check_jobs(project: Path, file: Path, count: int) -> None:
    """Each run was a job, with what the page's file asks for."""
    if "submitit_local" in file.read_text():
        assert len(list(project.rglob("*_submitted.pkl"))) == count
        return
    scripts = [path.read_text().splitlines() for path in (project / "slurm").glob("*.script")]
    assert len(list((project / "slurm").glob("*.pid"))) == count, "with arrays, fewer scripts"
    asked = ("--partition=cpu", "--time=240", "--mem=8GB", "--cpus-per-task=1")
    for script in scripts:
        assert {f"#SBATCH {option}" for option in asked} | {"module load python"} <= {*script}


@pytest.mark.slow
def test_grid_uses_the_launcher_of_a_file(project: Path, cluster: dict[str, str]) -> None:
    done = scilab_rl(*SHORT, FILE, "seed=1,2", "--multirun", cwd=project, timeout=400, **cluster)
    assert done.returncode == 0, done.stderr
    results = [json.loads(p.read_text())["status"] for p in project.glob("data/*/*/result.json")]
    assert results == ["finished"] * 2
    check_jobs(project, project / "conf" / "performance" / "my_cluster.yaml", 2)


@pytest.mark.slow
def test_study_uses_the_launcher_of_a_file(project: Path, cluster: dict[str, str]) -> None:
    done = scilab_rl(
        *SHORT, FILE, "algorithm.gamma=choice(0.9,0.95)", "hydra.sweeper.study_name=mine",
        "hydra.sweeper.max_trials=2", "hydra.sweeper.min_trials_per_param=1", "--multirun",
        cwd=project, timeout=400, **cluster,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    runs = runs_of(study_of(project, "mine"))
    assert [run.state for run in runs] == [COMPLETE] * 3
    check_jobs(project, project / "conf" / "performance" / "my_cluster.yaml", 3)
    winner = scilab_rl("+from_study=mine", "n_epochs=1", cwd=project)
    assert winner.returncode == 0, winner.stderr


@pytest.mark.slow
def test_experiment_uses_the_launcher_of_a_file(project: Path, cluster: dict[str, str]) -> None:
    words = ("base=sac", "variant=cleansac", "seeds=1", TINY, "n_epochs=1", *QUICK[1:3], "mlflow=0")
    done = scilab_rl(
        "experiment", *words, "require_updates=false", FILE, cwd=project, timeout=400, **cluster
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    check_jobs(project, project / "conf" / "performance" / "my_cluster.yaml", 2)


@pytest.mark.parametrize("command", [(), ("profile",)])
def test_single_run_refuses_a_launcher_that_it_would_not_use(
    command: tuple[str, ...], project: Path
) -> None:
    done = scilab_rl(*command, *SHORT, FILE, cwd=project)
    assert done.returncode == 2
    assert "submitit_slurm was chosen" in done.stderr
    assert "--multirun" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (project / "data").exists()


def test_keys_of_a_launcher_without_one_are_refused(project: Path) -> None:
    file = project / "conf" / "performance" / "my_cluster.yaml"
    file.write_text("# @package _global_\nhydra:\n  launcher: {partition: cpu}\n")
    for words in ((FILE,), ("hydra.launcher.partition=cpu",)):
        done = scilab_rl(*SHORT, *words, "seed=1,2", "--multirun", cwd=project)
        assert done.returncode == 2
        assert "hydra/launcher=submitit_slurm" in done.stderr
        assert done.stderr.count("\n") == 1


def test_local_launcher_tries_a_cluster_file_here(project: Path) -> None:
    words = (FILE, "hydra/launcher=local", "seed=1,2", "--multirun")
    done = scilab_rl(*SHORT, *words, cwd=project)
    assert done.returncode == 0, done.stderr
    assert "ignores partition, timeout_min, mem_gb, setup" in done.stderr
