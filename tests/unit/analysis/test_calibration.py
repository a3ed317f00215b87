"""Values as predictions of success, against numbers computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from scilab_rl.analysis.calibration import area_under_roc, calibrate, isotonic


def test_isotonic_regression_pools_adjacent_violators():
    # 1 before 0 is a violation: both get their mean.
    values, successes = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.0, 1.0, 0.0, 1.0])
    fitted = isotonic(values, successes, np.array([0.0, 1.0, 2.0, 2.5, 3.0, 4.0, 9.0]))
    np.testing.assert_allclose(fitted, [0, 0, 0.5, 0.5, 0.5, 1, 1])


def test_auc_counts_pairs():
    # Of the four pairs, (2, 1), (4, 1) and (4, 3) are right, (2, 3) is not.
    values, successes = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.0, 1.0, 0.0, 1.0])
    assert area_under_roc(values, successes) == 0.75


def test_values_that_say_nothing_are_not_flattered():
    rng = np.random.default_rng(1)
    successes = rng.random(2000) < 0.7
    found = calibrate(rng.random(2000), successes, np.repeat(np.arange(500), 4))
    assert found.auc.low < 0.5 < found.auc.high
    assert found.base_brier == pytest.approx(0.21, abs=0.02)  # p (1 - p)
    assert found.skill < 0.01


def test_true_probabilities_are_calibrated():
    rng = np.random.default_rng(2)
    truth = rng.random(4000)
    found = calibrate(10 * truth - 7, rng.random(4000) < truth, np.repeat(np.arange(100), 40))
    assert found.brier == pytest.approx(1 / 6, abs=0.015)  # the mean of p (1 - p)
    assert found.auc.value == pytest.approx(5 / 6, abs=0.02)
    for one in found.bins:
        assert abs(one.predicted - one.observed.value) < 0.07
    assert sum(one.n_episodes for one in found.bins) == 4000


def test_nothing_is_said_where_all_is_alike():
    assert calibrate(np.arange(10.0), np.ones(10), np.arange(10)) is None
    assert calibrate(np.arange(4.0), np.array([0, 1, 0, 1]), np.arange(4)) is None
