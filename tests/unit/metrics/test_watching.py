from __future__ import annotations

import numpy as np
import pytest

from scilab_rl.errors import ConfigError
from scilab_rl.metrics.events import EpisodeEvents
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.probes import Curve
from scilab_rl.metrics.triggers import parse_trigger


def test_lazy_value_is_computed_only_while_watched() -> None:
    logger, calls = MetricLogger(), []

    def expensive() -> float:
        calls.append(1)
        return 3.0

    logger.record_lazy("train/x", expensive)
    logger.watch(["train/y"])
    logger.record_lazy("train/x", expensive)
    assert not calls
    logger.watch(["train/x"])
    logger.record_lazy("train/x", expensive)
    assert logger.take_seen() == {"train/x": 3.0}
    assert logger.take_seen() == {}
    logger.watch([])
    logger.record_lazy("train/x", expensive)
    assert len(calls) == 1
    assert logger.take() == {}  # what is only drawn is no metric of the epoch


def test_watched_values_are_those_of_the_step_and_not_the_mean() -> None:
    logger = MetricLogger()
    logger.watch(["a", "b"])
    for value in (1.0, 3.0):
        logger.record_mean("a", value)
        logger.record("b", np.float32(value))
        logger.record("c", value)
        assert logger.take_seen() == {"a": value, "b": value}
    assert logger.take() == {"a": 2.0, "b": 3.0, "c": 3.0}


def test_success_is_an_event_when_it_changes() -> None:
    events = EpisodeEvents(in_space=True)
    assert events.of_scene(np.zeros(2), None) == ["episode start"]
    assert events.of_scene(np.zeros(2), False) == []
    assert events.of_scene(np.zeros(2), True) == ["success"]
    assert events.of_scene(np.zeros(2), True) == []
    assert events.of_scene(np.zeros(2), False) == ["success lost"]


def test_object_that_falls_off_the_table_is_an_event_once() -> None:
    events = EpisodeEvents(in_space=True)

    def at(height: float) -> list[str]:
        return events.of_scene({"achieved_goal": np.array([1.3, 0.7, height])}, False)

    assert [at(h) for h in (0.42, 0.40, 0.2, 0.02)] == [["episode start"], [], ["object fell"], []]


def test_goals_that_are_no_places_in_space_cannot_fall() -> None:
    events = EpisodeEvents(in_space=True)
    events.of_scene({"achieved_goal": np.array([5.0, 5.0])}, None)
    assert events.of_scene({"achieved_goal": np.array([-5.0, -5.0])}, None) == []


def test_goals_of_a_task_without_bodies_have_no_heights() -> None:
    events = EpisodeEvents(in_space=False)  # a car: place, velocity, orientation
    events.of_scene({"achieved_goal": np.array([0.0, 0.0, 3.0, 0.0, 1.0, 0.0])}, None)
    assert events.of_scene({"achieved_goal": np.array([5.0, 0.0, 0.0, 0.0, 1.0, 0.0])}, None) == []


def test_trigger_on_a_number_and_on_a_percentile() -> None:
    seen = np.arange(101.0)
    assert parse_trigger("q > 5").score({Curve("q"): 7.5}, [], seen) == 2.5
    assert parse_trigger("q < -1").score({Curve("q"): -3.0}, [], seen) == 2.0
    assert parse_trigger("q > p90").score({Curve("q"): 95.0}, [], seen) == pytest.approx(5.0)
    assert parse_trigger("q > p90").score({Curve("q"): 90.0}, [], seen) is None
    assert parse_trigger("q > 5").score({}, [], seen) is None


def test_trigger_on_an_event() -> None:
    trigger = parse_trigger("object fell")
    assert trigger.score({}, ["object fell"], np.zeros(0)) == 1.0
    assert trigger.score({}, ["success"], np.zeros(0)) is None


@pytest.mark.parametrize("text", ["succes", "q >", "q > p101", "q >> 3", "> 4", "q > x"])
def test_what_is_no_trigger(text: str) -> None:
    with pytest.raises(ConfigError, match="is not a condition"):
        parse_trigger(text)
