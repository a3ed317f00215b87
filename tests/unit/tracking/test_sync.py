"""Sending later what a tracker has missed, to the real MLflow and the real TensorBoard."""

import dataclasses
from pathlib import Path

import pytest

from scilab_rl.tracking.sync import sync

from .conftest import result, run_info

# MLflow's own imports and its database layer deprecate each other's functions.
pytestmark = pytest.mark.filterwarnings("ignore")
EPOCHS = [
    {"kind": "epoch", "epoch": 1, "step": 10, "eval/mean_reward": -1.5, "a[0]": 1.0},
    {"kind": "epoch", "epoch": 2, "step": 20, "eval/mean_reward": -0.5, "a[0]": 2.0, "late": 3.0},
]
ALL = {
    "eval/mean_reward": [(10, -1.5), (20, -0.5)],
    "a[0]": [(10, 1.0), (20, 2.0)],
    "late": [(20, 3.0)],
}


class MLflow:
    """What the tests want of MLflow."""

    takes_files = True

    def __init__(self, base: Path) -> None:
        self.base = base

    def tracker(self):
        from scilab_rl.tracking.mlflow import MLflowTracker

        return MLflowTracker()

    def client(self):
        from mlflow.tracking import MlflowClient

        return MlflowClient(f"sqlite:///{self.base / 'mlflow.db'}")

    def run(self, run):
        runs = self.client().search_runs(["1"], f"run_name LIKE '% {run.name}'")
        assert len(runs) == 1
        return runs[0]

    def points(self, run):
        run_id = self.run(run).info.run_id
        history = {
            name: self.client().get_metric_history(run_id, name.replace("a[0]", "a_x5b_0_x5d_"))
            for name in ALL
        }
        return {name: [(m.step, m.value) for m in points] for name, points in history.items()}

    def content(self, run):
        """Everything that there is, also the times."""
        found = self.run(run)
        names = [file.path for file in self.client().list_artifacts(found.info.run_id)]
        return dict(found.info), found.data.to_dictionary(), self.points(run), names


class TensorBoard:
    """What the tests want of TensorBoard."""

    takes_files = False

    def __init__(self, base: Path) -> None:
        pass

    def tracker(self):
        from scilab_rl.tracking.tensorboard import TensorBoardTracker

        return TensorBoardTracker()

    def points(self, run):
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        folder = str(run.run_dir / "tensorboard")
        events = EventAccumulator(folder, size_guidance={"scalars": 0}).Reload()
        known = events.Tags()["scalars"]
        return {n: [(e.step, e.value) for e in events.Scalars(n)] for n in ALL if n in known}

    def content(self, run):
        folder = run.run_dir / "tensorboard"
        return {path: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("data")


@pytest.fixture(params=[MLflow, TensorBoard], ids=["mlflow", "tensorboard"])
def place(request, base):
    if request.param is MLflow:
        pytest.importorskip("mlflow")
    else:
        pytest.importorskip("tensorboard")
    return request.param(base)


@pytest.fixture
def run(base, request):
    name = request.node.name.replace("[", "_").rstrip("]")
    return run_info(base, name, arguments={"gamma": 0.9, "odd[name]": 1}, group="g")


@pytest.fixture
def film(run):
    path = run.run_dir / "film.mp4"
    path.write_bytes(b"frames")
    return path


def test_a_run_that_is_not_there_is_sent_and_then_left_alone(place, run, film) -> None:
    n_files = int(place.takes_files)
    assert sync(place.tracker(), run, EPOCHS, [film], result()) == (5, n_files)
    assert place.points(run) == ALL
    before = place.content(run)
    assert sync(place.tracker(), run, EPOCHS, [film], result()) is None
    assert place.content(run) == before


def test_a_run_of_which_a_part_is_there_is_completed(place, run) -> None:
    tracker = place.tracker()
    tracker.begin(run)
    tracker.epoch(10, 1, {"eval/mean_reward": -1.5, "a[0]": 1.0})
    tracker.epoch(20, 2, {"a[0]": 2.0})
    tracker.end(result("interrupted"))
    assert sync(place.tracker(), run, EPOCHS, [], result()) == (2, 0)
    assert place.points(run) == ALL


def test_a_run_without_epochs(place, run) -> None:
    sync(place.tracker(), run, [], [], result("failed"))
    assert sync(place.tracker(), run, [], [], result("failed")) is None


@pytest.fixture
def mlflow(base):
    pytest.importorskip("mlflow")
    return MLflow(base)


def test_a_run_that_was_not_closed_is_closed(mlflow, run) -> None:
    tracker = mlflow.tracker()
    tracker.begin(run)
    for row in EPOCHS:
        tracker.epoch(row["step"], row["epoch"], {n: row[n] for n in ALL if n in row})
    assert mlflow.run(run).info.status == "RUNNING"
    assert sync(mlflow.tracker(), run, EPOCHS, [], result("failed")) == (0, 0)
    assert mlflow.run(run).info.status == "FAILED"
    assert mlflow.points(run) == ALL


def test_parameters_that_are_missing_are_sent_and_others_kept(mlflow, run) -> None:
    sync(mlflow.tracker(), run, EPOCHS, [], result())
    arguments = {"gamma": 0.5, "new": 1}
    algorithm = dataclasses.replace(run.cfg.algorithm, arguments=arguments)
    more = dataclasses.replace(run, cfg=dataclasses.replace(run.cfg, algorithm=algorithm))
    assert sync(mlflow.tracker(), more, EPOCHS, [], result()) == (0, 0)
    expected = {name: str(value) for name, value in run.cfg.flat().items()}
    del expected["algorithm.odd[name]"]
    assert mlflow.run(run).data.params == {
        **expected,
        "algorithm.gamma": "0.9",
        "algorithm.odd_x5b_name_x5d_": "1",
        "algorithm.new": "1",
    }
    assert sync(mlflow.tracker(), more, EPOCHS, [], result()) is None


def test_a_run_whose_id_was_lost_or_is_that_of_another_database(mlflow, run) -> None:
    sync(mlflow.tracker(), run, EPOCHS, [], result())
    id_file = run.run_dir / "mlflow_run_id.txt"
    for text in (None, "0" * 32, "no id at all"):
        id_file.unlink() if text is None else id_file.write_text(text)
        assert sync(mlflow.tracker(), run, EPOCHS, [], result()) is None
    assert mlflow.points(run) == ALL


def test_a_run_that_was_deleted_there_is_sent_anew(mlflow, run) -> None:
    sync(mlflow.tracker(), run, EPOCHS, [], result())
    mlflow.client().delete_run(mlflow.run(run).info.run_id)
    assert sync(mlflow.tracker(), run, EPOCHS, [], result()) == (5, 0)
    assert mlflow.points(run) == ALL
