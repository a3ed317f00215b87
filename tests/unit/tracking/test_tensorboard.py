import pytest

from .conftest import result, run_info

pytest.importorskip("tensorboard")


def test_what_is_written_can_be_read_back(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    from scilab_rl.tracking.tensorboard import TensorBoardTracker

    tracker, run = TensorBoardTracker(), run_info(tmp_path)
    tracker.begin(run)
    tracker.epoch(10, 1, {"eval/mean_reward": -1.5, "train/loss": 0.25})
    tracker.epoch(20, 2, {"eval/mean_reward": -0.5})
    tracker.end(result())
    events = EventAccumulator(str(run.run_dir / "tensorboard")).Reload()
    assert events.Tags()["scalars"] == ["eval/mean_reward", "train/loss"]
    series = [(event.step, event.value) for event in events.Scalars("eval/mean_reward")]
    assert series == [(10, -1.5), (20, -0.5)]


def test_different_names_are_different_metrics(tmp_path):
    from scilab_rl.tracking.tensorboard import TensorBoardTracker

    names = ("train/α", "train/β", "train/_", "a b", "a_b", "A_b", "a//b", "a/b", "q[0]", "x" * 300)
    tracker, run = TensorBoardTracker(), run_info(tmp_path)
    tracker.begin(run)
    tracker.epoch(10, 1, dict.fromkeys(names, 1.0))
    tracker.end(result())
    assert tracker.remote_state(run, names, result()).steps == {name: {10} for name in names}
