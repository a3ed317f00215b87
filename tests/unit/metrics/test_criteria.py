import math

import pytest

from scilab_rl.metrics.criteria import final_score, is_better, should_stop_early
from scilab_rl.metrics.store import MetricStore


@pytest.mark.parametrize(
    ("series", "threshold", "last_n", "expected"),
    [
        ([], 0.9, 1, False),
        ([0.9], 0.9, 1, True),
        ([0.89], 0.9, 1, False),
        ([1.0, 1.0], 0.9, 3, False),
        ([0.9, 0.9, 0.9], 0.9, 3, True),
        ([0.7, 1.0, 1.0], 0.9, 3, True),
        ([0.6, 1.0, 1.0], 0.9, 3, False),
        ([1.0, 1.0, 1.0, 0.0], 0.9, 3, False),
        ([0.0, 1.0, 1.0, 1.0], 0.9, 3, True),
        ([-50.0, -39.0], -40, 1, True),
        ([-39.0, -41.0], -40, 1, False),
        ([math.nan, 1.0], 0.9, 2, False),
        ([math.inf], 0.9, 1, True),
    ],
)
def test_early_stop_is_the_mean_of_the_last_epochs(series, threshold, last_n, expected):
    assert should_stop_early(series, threshold, last_n) is expected


def store_of(*values):
    store = MetricStore()
    for i, value in enumerate(values):
        store.append(10 * i, {} if value is None else {"x": value})
    return store


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((), None),
        ((1.0, 2.0), 2.0),
        ((1.0, None), 1.0),
        ((1.0, math.nan), None),
        ((math.inf,), None),
    ],
)
def test_the_score_is_the_last_number(values, expected):
    assert final_score(store_of(*values), "x") == expected
    assert final_score(store_of(*values), "y") is None


def test_success_counts_before_reward():
    assert is_better((0.0, -50.0), None)
    assert is_better((0.2, -50.0), (0.1, -1.0))
    assert is_better((0.2, -40.0), (0.2, -50.0))
    assert not is_better((0.2, -50.0), (0.2, -50.0))
    assert not is_better((0.1, 0.0), (0.2, -50.0))


def test_the_store_keeps_rows_as_they_were():
    store, row = MetricStore(), {"a": 1.0}
    store.append(10, row)
    row["a"] = 2.0
    store.append(20, {"b": 3.0})
    assert store.series("a") == [1.0]
    assert store.latest("a") == 1.0
    assert store.latest("c") is None
    assert (len(store), store.steps) == (2, [10, 20])
