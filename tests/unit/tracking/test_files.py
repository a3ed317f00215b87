import csv
import json
import os

import pytest

from scilab_rl.errors import ScilabRLError
from scilab_rl.run.directory import RunDirectory, read_epochs
from scilab_rl.tracking.files import FilesTracker

from .conftest import result, run_info


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def opened(tmp_path):
    tracker, run = FilesTracker(), run_info(tmp_path)
    tracker.begin(run)
    yield tracker, run.run_dir
    tracker.end(result())


def test_one_row_per_epoch_with_the_time_columns_last(opened):
    tracker, folder = opened
    tracker.epoch(10, 1, {"time/fps": 5.0, "train/loss": 0.5, "eval/mean_reward": -1.0})
    tracker.epoch(20, 2, {"eval/mean_reward": -0.5, "time/fps": 6.0, "train/loss": 0.25})
    tracker.end(result())
    assert (folder / "metrics.csv").read_text() == (
        "epoch,step,eval/mean_reward,train/loss,time/fps\n1,10,-1.0,0.5,5.0\n2,20,-0.5,0.25,6.0\n"
    )


def test_a_metric_that_comes_later_gets_a_column_and_older_rows_stay_empty(opened):
    tracker, folder = opened
    tracker.epoch(10, 1, {"b": 1.0, "time/fps": 5.0})
    tracker.epoch(20, 2, {"a": 2.0, "b": 3.0, "time/fps": 5.0})
    tracker.epoch(30, 3, {"time/fps": 5.0})
    lines = (folder / "metrics.csv").read_text().splitlines()
    assert lines == ["epoch,step,a,b,time/fps", "1,10,,1.0,5.0", "2,20,2.0,3.0,5.0", "3,30,,,5.0"]


def test_jsonl_has_a_whole_line_for_each_epoch_and_episode_at_once(opened):
    tracker, folder = opened
    tracker.episode({"step": 5, "reward": -2.0, "success": True})
    tracker.epoch(10, 1, {"eval/mean_reward": -1.0})
    # read before anything is closed: a killed run has these lines too
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert lines == [
        {"kind": "episode", "step": 5, "reward": -2.0, "success": True},
        {"kind": "epoch", "epoch": 1, "step": 10, "eval/mean_reward": -1.0},
    ]
    assert read_epochs(RunDirectory(folder)) == lines[1:]


def test_numbers_survive_exactly(opened):
    tracker, folder = opened
    value = 0.1 + 0.2
    tracker.epoch(10, 1, {"x": value})
    assert float(rows_of(folder / "metrics.csv")[0]["x"]) == value


def test_a_resumed_run_drops_what_it_will_measure_again(tmp_path):
    first, run = FilesTracker(), run_info(tmp_path)
    first.begin(run)
    for epoch in (1, 2, 3):
        first.episode({"step": 10 * epoch - 5})
        first.epoch(10 * epoch, epoch, {"x": float(epoch)})
    first.end(result())
    with (run.run_dir / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "epoch", "st')  # killed while it wrote
    second = FilesTracker()
    second.begin(run_info(tmp_path, resumed_step=20))
    second.epoch(30, 3, {"x": 3.5, "y": 1.0})
    second.end(result())
    rows = rows_of(run.run_dir / "metrics.csv")
    assert [(row["step"], row["x"], row["y"]) for row in rows] == [
        ("10", "1.0", ""),
        ("20", "2.0", ""),
        ("30", "3.5", "1.0"),
    ]
    lines = (run.run_dir / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [5, 10, 15, 20, 30]


def test_a_full_disk_is_one_line_with_file_and_space(opened):
    tracker, folder = opened
    (folder / "metrics.csv").symlink_to("/dev/full")
    tracker._columns = ["epoch", "step", "x"]
    with pytest.raises(
        ScilabRLError, match=r"metrics.csv' cannot be written: No space left .*free"
    ):
        tracker.epoch(10, 1, {"x": 1.0})


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_became_read_only_is_one_line(opened):
    tracker, folder = opened
    folder.chmod(0o555)
    try:
        with pytest.raises(ScilabRLError, match="Permission denied"):
            tracker.epoch(10, 1, {"x": 1.0})
    finally:
        folder.chmod(0o755)
