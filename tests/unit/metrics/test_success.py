"""Success is a truth value, and a rate is over all episodes."""

import numpy as np
import pytest
import torch

from scilab_rl.metrics.success import episode_outcomes, success_metrics, success_of


@pytest.mark.parametrize(
    "value",
    [True, np.True_, 1, 1.0, np.float32(1), np.array([True]), np.array([[1]]), [1],
     torch.tensor([1.0])],
)  # fmt: skip
def test_truth_values_are_read(value) -> None:
    assert success_of({"is_success": value}) is True


@pytest.mark.parametrize(
    "value",
    [float("nan"), np.nan, "False", "", 0.5, 2, -1, [], np.zeros(2), np.array([np.nan]),
     np.array(["1"]), {"yes": 1}, object()],
)  # fmt: skip
def test_anything_else_is_refused(value) -> None:
    with pytest.raises(ValueError, match=r"info\['is_success'\] is .*, but success must be True"):
        success_of({"is_success": value})


def test_nothing_is_reported_without_a_value() -> None:
    assert success_of({}) is None
    assert success_of({"is_success": None}) is None
    assert success_of({"is_success": None, "success": 0}) is False


def test_silent_episodes_count_once_the_task_is_known_to_report() -> None:
    silent = [None, None]
    assert episode_outcomes(silent) is None
    assert episode_outcomes(silent, reports_success=True) == [False, False]
    assert success_metrics([False, False], silent) == {
        "success_rate": 0.0,
        "success_not_reported": 2.0,
    }
