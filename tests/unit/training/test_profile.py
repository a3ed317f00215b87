from __future__ import annotations

import time

import pytest

from scilab_rl.training.profile import OTHER, Profile


class Worker:
    """Waits for known times, one method inside the other."""

    def outer(self) -> str:
        time.sleep(0.02)
        self.inner()
        self.inner()
        return "done"

    def inner(self) -> None:
        time.sleep(0.03)

    def fail(self) -> None:
        time.sleep(0.01)
        raise ValueError("as planned")


@pytest.fixture
def worker() -> Worker:
    return Worker()


def test_each_second_belongs_to_one_part(worker: Worker) -> None:
    profile = Profile()
    profile.measure("outside", worker, "outer")
    profile.measure("inside", worker, "inner")
    profile.start()
    assert worker.outer() == "done"
    time.sleep(0.04)
    profile.stop()
    parts = profile.parts
    assert {name: part.n_calls for name, part in parts.items()} == {
        "outside": 1,
        "inside": 2,
        OTHER: 1,
    }
    assert parts["inside"].seconds >= 0.06
    assert 0.02 <= parts["outside"].seconds < parts["inside"].seconds
    assert parts[OTHER].seconds >= 0.04
    assert sum(part.seconds for part in parts.values()) == pytest.approx(profile.seconds)


def test_an_error_goes_through_and_its_time_is_counted(worker: Worker) -> None:
    profile = Profile()
    profile.measure("failing", worker, "fail")
    with pytest.raises(ValueError, match="as planned"):
        worker.fail()
    assert profile.parts["failing"].seconds >= 0.01


def test_what_an_object_cannot_do_is_left_out(worker: Worker) -> None:
    profile = Profile()
    profile.measure("none", worker, "fly")
    profile.measure("none", None, "sample")
    assert not profile.parts
