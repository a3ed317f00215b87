import logging

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Figure

from scilab_rl.errors import AlgorithmError
from scilab_rl.metrics.logger import MetricLogger, as_number


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (3, 3.0),
        (True, 1.0),
        (np.float32(0.5), 0.5),
        (np.int64(2), 2.0),
        (np.array([1.5]), 1.5),
        (np.array(2.5), 2.5),
        (torch.tensor(0.25), 0.25),
        (torch.tensor([[4.0]], requires_grad=True), 4.0),
        ("text", None),
        (None, None),
        (np.zeros(2), None),
        (torch.zeros(2), None),
        (np.array(["a"]), None),
        ([1.0], None),
        (1 + 2j, None),
        (Figure(None, close=True), None),
    ],
)
def test_what_holds_one_number_is_a_number(value, expected):
    assert as_number(value) == expected
    assert type(as_number(value)) is (float if expected is not None else type(None))


def test_the_newest_value_of_an_epoch_counts_and_means_are_means():
    logger = MetricLogger()
    logger.record("a", 1.0)
    logger.record("a", torch.tensor(2.0))
    for value in (1.0, 2.0, None, 6.0):
        logger.record_mean("b", value)
    logger.record("c", "text")
    assert logger.take() == {"a": 2.0, "b": 3.0}
    assert logger.take() == {}
    logger.record_mean("b", 10.0)
    assert logger.take() == {"b": 10.0}


def test_an_unfinished_epoch_survives_a_checkpoint():
    one, two = MetricLogger(), MetricLogger()
    one.record("a", 1.0)
    one.record_mean("b", 1.0)
    two.set_state(one.state())
    for logger in (one, two):
        logger.record_mean("b", 4.0)
    assert one.take() == two.take() == {"a": 1.0, "b": 2.5}


def test_messages_of_algorithms_go_to_the_log(caplog):
    logger = MetricLogger()
    with caplog.at_level(logging.DEBUG, "scilab_rl.algorithm"):
        logger.info("learned", 3, "times")
        logger.warn("slow")
        logger.error("bad")
    messages = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert messages == [("INFO", "learned 3 times"), ("WARNING", "slow"), ("ERROR", "bad")]


def test_a_dump_of_the_algorithm_ends_no_epoch():
    logger = MetricLogger()
    logger.record("a", 1.0)
    logger.dump(100)
    assert logger.take() == {"a": 1.0}


@pytest.mark.parametrize("name", ["epoch", "step", "kind"])
def test_a_metric_cannot_replace_a_column_that_describes_the_row(name):
    logger = MetricLogger()
    logger.record(name, 5)
    with pytest.raises(AlgorithmError, match=f"as in train/{name}"):
        logger.take()
