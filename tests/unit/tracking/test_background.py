import logging
import threading
import time

import pytest

from scilab_rl.tracking.background import BackgroundTracker
from scilab_rl.tracking.base import Tracker

from .conftest import result, run_info


class Remembering(Tracker):
    """Raises where it is told to, and remembers what it got through."""

    def __init__(self, failing=(), seconds=0.0):
        self.failing = failing
        self.seconds = seconds
        self.heard = []
        self.threads = set()

    def _hear(self, what):
        self.threads.add(threading.current_thread())
        time.sleep(self.seconds)
        if what in self.failing:
            raise RuntimeError(f"no {what} today\nand a second line")
        self.heard.append(what)

    def begin(self, run):
        self._hear("begin")

    def epoch(self, step, epoch, values):
        self._hear(epoch)

    def artifact(self, path):
        self._hear(path.name)

    def end(self, result):
        self._hear("end")


@pytest.fixture
def warnings_of(caplog):
    def collect():
        return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]

    return collect


def tell(mirror, tmp_path, n_epochs=5):
    """Tell the course of a run, and return the seconds that training had to wait for it."""
    started = time.monotonic()
    mirror.begin(run_info(tmp_path))
    for epoch in range(1, n_epochs + 1):
        mirror.epoch(10 * epoch, epoch, {"eval/mean_reward": 1.0})
    mirror.artifact(tmp_path / "film.mp4")
    waited = time.monotonic() - started
    mirror.end(result())
    return waited


def test_everything_arrives_in_order_in_another_thread(tmp_path, warnings_of):
    tracker = Remembering()
    tell(BackgroundTracker(tracker, "X"), tmp_path)
    assert tracker.heard == ["begin", 1, 2, 3, 4, 5, "film.mp4", "end"]
    assert threading.current_thread() not in tracker.threads
    assert len(tracker.threads) == 1
    assert warnings_of() == []


def test_values_are_those_of_the_call(tmp_path):
    seen = []

    class Late(Remembering):
        def epoch(self, step, epoch, values):
            time.sleep(0.05)
            seen.append(dict(values))

    mirror, values = BackgroundTracker(Late(), "X"), {"a": 1.0}
    mirror.begin(run_info(tmp_path))
    mirror.epoch(10, 1, values)
    values["a"] = 2.0
    mirror.end(result())
    assert seen == [{"a": 1.0}]


def test_a_tracker_that_cannot_begin_is_off_with_one_warning(tmp_path, warnings_of):
    tracker = Remembering(failing=("begin",))
    tell(BackgroundTracker(tracker, "MLflow"), tmp_path)
    assert tracker.heard == []
    (warning,) = warnings_of()
    assert warning.startswith(
        "MLflow is switched off for this run: no begin today. Nothing is lost"
    )
    assert "second line" not in warning


def test_one_failure_is_forgiven(tmp_path, warnings_of):
    tracker = Remembering(failing=(2,))
    tell(BackgroundTracker(tracker, "X"), tmp_path)
    assert tracker.heard == ["begin", 1, 3, 4, 5, "film.mp4", "end"]
    assert warnings_of() == []


def test_three_failures_in_a_row_are_not_but_the_tracker_is_closed(tmp_path, warnings_of):
    tracker = Remembering(failing=(2, 3, 4))
    tell(BackgroundTracker(tracker, "X"), tmp_path)
    assert tracker.heard == ["begin", 1, "end"]
    assert len(warnings_of()) == 1


def test_failures_that_are_not_in_a_row_do_not_count(tmp_path, warnings_of):
    tracker = Remembering(failing=(1, 3, 5))
    tell(BackgroundTracker(tracker, "X"), tmp_path)
    assert tracker.heard == ["begin", 2, 4, "film.mp4", "end"]
    assert warnings_of() == []


def test_a_library_that_calls_exit_is_survived(tmp_path, warnings_of):
    class Exiting(Remembering):
        def begin(self, run):
            raise SystemExit("bye")

    tell(BackgroundTracker(Exiting(), "X"), tmp_path)
    assert len(warnings_of()) == 1


def test_training_never_waits_for_a_slow_tracker(tmp_path, warnings_of):
    tracker = Remembering(seconds=0.05)
    assert tell(BackgroundTracker(tracker, "X"), tmp_path) < 0.05
    assert tracker.heard[-1] == "end"
    assert warnings_of() == []


def test_a_hanging_tracker_costs_its_patience_at_the_end_and_no_more(tmp_path, warnings_of):
    released = threading.Event()

    class Hanging(Remembering):
        def begin(self, run):
            released.wait(30)

    mirror = BackgroundTracker(Hanging(), "X", patience_seconds=0.2)
    started = time.monotonic()
    waited = tell(mirror, tmp_path)
    ended = time.monotonic() - started
    released.set()
    assert waited < 0.1
    assert 0.2 <= ended < 1.0
    assert warnings_of() == [
        "X is switched off for this run: it did not finish within 0.2 s. Nothing is lost: all "
        "metrics are in the run's own files."
    ]


@pytest.mark.skipif(
    not hasattr(time, "pthread_getcpuclockid"), reason="no processor time of single threads here"
)
@pytest.mark.parametrize("works_for, is_heard", [(1.0, True), (60.0, False)])
def test_a_tracker_at_work_gets_more_time_but_not_forever(
    tmp_path, warnings_of, works_for, is_heard
):
    class Computing(Remembering):
        def begin(self, run):
            end = time.monotonic() + works_for
            while time.monotonic() < end and not over.is_set():
                sum(range(1000))
            super().begin(run)

    over = threading.Event()
    mirror = BackgroundTracker(Computing(), "X", patience_seconds=0.2)
    started = time.monotonic()
    tell(mirror, tmp_path)
    assert 0.5 < time.monotonic() - started < 15.0
    assert bool(mirror.tracker.heard) == is_heard
    assert len(warnings_of()) == (0 if is_heard else 1)
    over.set()


def test_a_full_queue_switches_off_once_and_still_closes(tmp_path, warnings_of):
    tracker = Remembering(seconds=0.05)
    mirror = BackgroundTracker(tracker, "X", queue_size=2)
    mirror.begin(run_info(tmp_path))
    time.sleep(0.1)  # let it begin
    for epoch in range(20):
        mirror.epoch(10 * epoch, epoch, {})
    mirror.end(result())
    assert tracker.heard[0] == "begin"
    assert tracker.heard[-1] == "end"
    assert len(tracker.heard) < 10
    assert [w.partition(": ")[2].partition(".")[0] for w in warnings_of()] == ["it is too slow"]


def test_steps_and_training_episodes_are_not_mirrored(tmp_path):
    class Listening(Remembering):
        def step(self, step):
            self._hear("step")

        def episode(self, episode):
            self._hear("episode")

    tracker = Listening()
    mirror = BackgroundTracker(tracker, "X")
    mirror.begin(run_info(tmp_path))
    mirror.step(1)
    mirror.episode({"step": 1})
    mirror.end(result())
    assert tracker.heard == ["begin", "end"]
