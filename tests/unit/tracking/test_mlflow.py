"""The real MLflow on a real SQLite database."""

import http.server
import socket
import sqlite3
import threading
import time

import pytest

from .conftest import result, run_info

pytest.importorskip("mlflow")
# MLflow's own imports and its database layer deprecate each other's functions.
pytestmark = pytest.mark.filterwarnings("ignore")

ONE_RUN = """
    import sys
    from pathlib import Path
    connected = []
    note = {"socket.connect": connected.append}
    sys.addaudithook(lambda event, args: note.get(event, len)(args))
    from scilab_rl.results import RunResult
    from scilab_rl.config.schema import AlgorithmConfig, RunConfig
    from scilab_rl.tracking.base import TrackedRun
    from scilab_rl.tracking.mlflow import MLflowTracker
    base, name = Path(sys.argv[1]), sys.argv[2]
    folder = base / "2026-01-02" / name
    folder.mkdir(parents=True)
    tracker = MLflowTracker()
    sac = AlgorithmConfig("sac")
    cfg = RunConfig("TinyReach-v0", base_logdir=str(base), seed=7, n_epochs=2, algorithm=sac)
    tracker.begin(TrackedRun(cfg, folder))
    tracker.epoch(10, 1, {"eval/mean_reward": -1.0})
    tracker.end(RunResult("finished", 0.5, 2, 20, 3.0, str(folder)))
    print("connected", connected)
"""


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """A database that MLflow itself has created; that takes seconds."""
    from scilab_rl.tracking.mlflow import prepare_database

    base = tmp_path_factory.mktemp("data")
    prepare_database(base)
    return base


@pytest.fixture
def started(database, request):
    """A tracker with an open run."""
    from scilab_rl.tracking.mlflow import MLflowTracker

    arguments = {"gamma": 0.9, "long": "x" * 7000, "odd[name]": None}
    arguments |= {f"p{i}": i for i in range(150)}
    facts = {"arguments": arguments, "tags": ("mine",), "group": "g", "info": "a note"}
    run = run_info(database, request.node.name, **facts)
    tracker = MLflowTracker()
    tracker.begin(run)
    return tracker, run


def stored(tracker):
    return tracker._client.get_run(tracker._run_id)


def test_a_run_has_name_tags_and_all_parameters(started):
    tracker, run = started
    data = stored(tracker).data
    assert stored(tracker).info.run_name == f"{run.cfg.algorithm.name} s{run.cfg.seed} {run.name}"
    assert (data.tags["mine"], data.tags["group"]) == ("true", "g")
    assert data.tags["mlflow.note.content"] == "a note"
    assert data.params["algorithm.gamma"] == "0.9"
    assert data.params["algorithm.odd_x5b_name_x5d_"] == "None"
    assert len(data.params["algorithm.long"]) == 6000
    assert len(data.params) == len(run.parameters) > 153


def test_a_deleted_run_is_in_the_trash_and_deleted_once(started):
    tracker, run = started
    assert tracker.delete(run)
    assert stored(tracker).info.lifecycle_stage == "deleted"
    assert not tracker.delete(run)


def test_runs_of_a_group_are_shown_below_one_run(started):
    from scilab_rl.tracking.mlflow import MLflowTracker

    first, run = started
    second = MLflowTracker()
    second.begin(run_info(run.base_logdir, "second_of_group", group="g"))
    parents = {stored(tracker).data.tags["mlflow.parentRunId"] for tracker in (first, second)}
    assert len(parents) == 1
    assert first._client.get_run(parents.pop()).info.run_name == "g"


def test_an_epoch_is_one_batch_at_its_step(started):
    tracker, _ = started
    tracker.epoch(10, 1, {"eval/mean_reward": -1.5, "train/loss": float("nan"), "a[0]": 2.0})
    tracker.epoch(20, 2, {"eval/mean_reward": -0.5})
    history = tracker._client.get_metric_history(tracker._run_id, "eval/mean_reward")
    assert [(metric.step, metric.value) for metric in history] == [(10, -1.5), (20, -0.5)]
    metrics = stored(tracker).data.metrics
    assert metrics["a_x5b_0_x5d_"] == 2.0
    assert metrics["train/loss"] != metrics["train/loss"]


def test_a_file_lands_beside_the_database(started, database, tmp_path):
    tracker, _ = started
    film = tmp_path / "film.mp4"
    film.write_bytes(b"frames")
    tracker.artifact(film)
    (kept,) = (database / "mlflow_artifacts").rglob("film.mp4")
    assert kept.read_bytes() == b"frames"


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ("finished", "FINISHED"),
        ("solved", "FINISHED"),
        ("failed", "FAILED"),
        ("interrupted", "KILLED"),
    ],
)
def test_the_end_has_a_status(started, status, expected):
    tracker, _ = started
    assert stored(tracker).info.status == "RUNNING"
    tracker.end(result(status))
    assert stored(tracker).info.status == expected


def test_a_resumed_run_goes_on_under_its_id(started):
    from scilab_rl.tracking.mlflow import MLflowTracker

    first, run = started
    first.epoch(10, 1, {"x": 1.0})
    first.end(result("interrupted"))
    second = MLflowTracker()
    second.begin(run)
    second.epoch(20, 2, {"x": 2.0})
    assert second._run_id == first._run_id
    assert stored(second).info.status == "RUNNING"
    assert len(second._client.get_metric_history(second._run_id, "x")) == 2


def test_a_run_id_that_the_database_does_not_know_begins_anew(database):
    from scilab_rl.tracking.mlflow import MLflowTracker

    run = run_info(database, "moved_here")
    (run.run_dir / "mlflow_run_id.txt").write_text("0" * 32)
    tracker = MLflowTracker()
    tracker.begin(run)
    assert stored(tracker).info.run_name.endswith(" moved_here")
    assert (run.run_dir / "mlflow_run_id.txt").read_text() == tracker._run_id


def test_two_processes_create_the_database_at_once_offline_and_nothing_else(tmp_path, in_a_process):
    base = tmp_path / "data"
    base.mkdir()
    processes = [in_a_process(ONE_RUN, base, name) for name in ("a", "b")]
    for process in processes:
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
        assert output.strip() == "connected []"
    assert {path.name for path in base.iterdir()} == {"mlflow.db", ".mlflow.lock", "2026-01-02"}
    assert list(in_a_process.home.iterdir()) == list(in_a_process.folder.iterdir()) == []
    connection = sqlite3.connect(base / "mlflow.db")
    assert connection.execute("select name, status from runs order by name").fetchall() == [
        ("sac s7 a", "FINISHED"),
        ("sac s7 b", "FINISHED"),
    ]
    connection.close()


@pytest.fixture
def address():
    """Servers that are not there, that never answer, and that always fail."""
    listener = socket.create_server(("127.0.0.1", 0))
    open_port = listener.getsockname()[1]
    with socket.create_server(("127.0.0.1", 0)) as closed:
        closed_port = closed.getsockname()[1]

    class Failing(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(500)

        do_POST = do_GET

        def log_message(self, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Failing)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield {"closed": closed_port, "silent": open_port, "failing": server.server_port}
    server.shutdown()
    server.server_close()
    listener.close()


@pytest.mark.parametrize(
    "kind", ["closed", "failing", pytest.param("silent", marks=pytest.mark.slow)]
)
def test_a_server_that_does_not_answer_costs_one_warning(tmp_path, address, kind, caplog):
    from scilab_rl.tracking.background import BackgroundTracker
    from scilab_rl.tracking.mlflow import MLflowTracker

    mirror = BackgroundTracker(MLflowTracker(f"http://127.0.0.1:{address[kind]}"), "mlflow")
    started = time.monotonic()
    mirror.begin(run_info(tmp_path))
    mirror.epoch(10, 1, {"x": 1.0})
    assert time.monotonic() - started < 0.5
    mirror.end(result())
    assert time.monotonic() - started < 15.0
    switched_off = [r.getMessage() for r in caplog.records if "switched off" in r.getMessage()]
    assert len(switched_off) == 1


def test_different_names_are_different_metrics(started):
    tracker, run = started
    long = "train/" + 300 * "x"
    names = (
        "train/α", "train/β", "train/_", "a b", "a_b", "A_b", "a//b", "a/b", "/a", "..",
        f"{long}1", f"{long}2", "q[0]", "q[1]", "train/_x3b1_",
    )  # fmt: skip
    tracker.epoch(10, 1, {name: float(i) for i, name in enumerate(names)})
    tracker.end(result())
    metrics = stored(tracker).data.metrics
    assert sorted(metrics.values()) == [float(i) for i in range(len(names))]
    assert metrics["train/_x3b1_"] == 0.0 and metrics["a b"] == 3.0
    assert tracker.remote_state(run, names, result()).steps == {name: {10} for name in names}


def test_groups_and_tags_of_any_characters(database):
    from scilab_rl.tracking.mlflow import MLflowTracker

    parents = set()
    for group in ("α", "β", "it's"):
        tracker = MLflowTracker()
        tracker.begin(run_info(database, f"of {ord(group[0])}", group=group, tags=(group,)))
        parents.add(stored(tracker).data.tags["mlflow.parentRunId"])
        tracker.end(result())
    assert len(parents) == 3
