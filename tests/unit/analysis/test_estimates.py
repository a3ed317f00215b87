"""Aggregates and tests of few runs, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from scilab_rl.analysis.comparison import holm
from scilab_rl.analysis.estimates import (
    aggregate,
    curve_band,
    difference,
    interquartile_mean,
    performance_profile,
    permutation_test,
    probability_of_improvement,
    seeds_needed,
    smallest_p,
)

LOW, HIGH = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.6, 0.7, 0.8, 0.9])


def test_interquartile_mean_leaves_a_quarter_out_at_each_end() -> None:
    assert interquartile_mean(np.array([9.0, 0.0, 1.0, 2.0])) == 1.5
    assert interquartile_mean(np.array([0.0, 3.0, 6.0])) == 3.0  # too few to leave any out
    assert interquartile_mean(np.arange(8.0)).item() == 3.5
    rows = np.random.default_rng(0).random((2, 13, 3)).swapaxes(1, 2)  # three are left out of 13
    by_hand = np.sort(rows, axis=-1)[..., 3:10].mean(axis=-1)
    np.testing.assert_allclose(interquartile_mean(rows), by_hand, rtol=0, atol=1e-12)


def test_bootstrap_draws_within_tasks() -> None:
    """Two tasks without any spread: mixing them would spread the mean."""
    estimate = aggregate([np.zeros(5), np.ones(5)], "mean")
    assert (estimate.value, estimate.low, estimate.high) == (0.5, 0.5, 0.5)


def test_bootstrap_interval_of_the_mean_has_the_known_width() -> None:
    values = np.random.default_rng(1).normal(0, 1, 400)
    estimate = aggregate([values], "mean")
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 / 20, rel=0.15)


def test_probability_of_improvement_counts_wins_and_half_of_ties() -> None:
    assert probability_of_improvement([LOW], [HIGH]).value == 1.0
    assert probability_of_improvement([LOW], [LOW]).value == 0.5
    # 2 beats 1 and 0, ties with 2: 2.5 of 3; 0 only ties with 0: 0.5 of 3.
    ours, theirs = np.array([0.0, 1.0, 2.0]), np.array([2.0, 0.0])
    assert probability_of_improvement([ours], [theirs]).value == pytest.approx(0.5)


def test_pairs_take_out_what_both_runs_of_a_seed_share() -> None:
    seeds = np.array([0.0, 10.0, 20.0, 30.0])
    paired = difference([seeds], [seeds + 1], "mean", paired=True)
    unpaired = difference([seeds], [seeds + 1], "mean", paired=False)
    assert (paired.value, paired.low, paired.high) == (1.0, 1.0, 1.0)
    assert unpaired.high - unpaired.low > 10


def test_performance_profile_is_the_share_of_runs_above() -> None:
    value, low, high = performance_profile([LOW], np.array([0.0, 0.25, 0.3, 0.5]))
    assert list(value) == [1.0, 0.5, 0.5, 0.0]
    assert (low <= value).all() and (value <= high).all()


def test_curve_band_has_a_point_per_step() -> None:
    value, low, high = curve_band([np.array([[0.0, 1.0], [0.2, 1.0]])])
    assert list(value) == [0.1, 1.0]
    assert (low[0], high[0]) == (0.0, 0.2)
    assert (low[1], high[1]) == (1.0, 1.0)


def test_permutation_test_is_exact() -> None:
    # Of the 70 ways to divide eight runs, the observed one and its mirror image are as extreme.
    assert permutation_test([LOW], [HIGH], paired=False) == pytest.approx(2 / 70)
    # Of the 16 signs of four pairs, all plus and all minus are.
    assert permutation_test([LOW], [HIGH], paired=True) == pytest.approx(2 / 16)
    assert permutation_test([LOW], [LOW], paired=True) == 1.0


def test_permutation_test_agrees_with_that_of_scipy() -> None:
    from scipy import stats

    rng = np.random.default_rng(4)
    for n, m, kind in ((3, 3, "samples"), (8, 8, "samples"), (4, 4, "independent"),
                       (5, 7, "independent"), (2, 9, "independent")):  # fmt: skip
        ours, theirs = rng.random(n).round(2), rng.random(m).round(2) + 0.2
        expected = stats.permutation_test(
            (ours, theirs),
            lambda x, y, axis=-1: np.abs(y.mean(axis=axis) - x.mean(axis=axis)).round(12),
            permutation_type=kind, alternative="greater", vectorized=True,
        ).pvalue  # fmt: skip
        p = permutation_test([ours], [theirs], paired=kind == "samples")
        assert p == pytest.approx(expected, abs=1e-9)


def test_permutation_test_keeps_its_level() -> None:
    rng, found = np.random.default_rng(8), 0
    for _ in range(300):
        found += permutation_test([rng.random(5)], [rng.random(5)], paired=False) <= 0.05
    assert found / 300 <= 0.08


def test_permutation_test_over_tasks_keeps_runs_in_their_task() -> None:
    """The second task is ten times harder, in the same way for both groups."""
    scores = [np.array([0.9, 0.8, 0.7]), np.array([0.09, 0.08, 0.07])]
    other = [scores[0] - 0.5, scores[1] - 0.05]
    assert permutation_test(scores, other, paired=False) < 0.2
    assert permutation_test(scores, scores, paired=False) == 1.0


def test_how_many_seeds_would_decide() -> None:
    # 2 (1.96 + 0.84)^2 s^2 / d^2 with s^2 = 1/60 and d = 0.5 is about 1; but fewer than four runs
    # of each group cannot reach p = 0.05 in a permutation test, and six pairs are needed.
    assert seeds_needed([LOW], [HIGH], paired=False, at_least=0.01) == 4
    assert smallest_p(3, 3, paired=False) == 0.1
    assert seeds_needed([LOW], [HIGH], paired=True, at_least=0.01) == 6
    # Four comparisons need p = 0.0125 each: 2 / 2 ** 8 = 0.0078 is below it, 2 / 2 ** 7 is not.
    assert seeds_needed([LOW], [HIGH], paired=True, at_least=0.01, level=0.0125) == 8
    noisy = np.array([0.0, 1.0, 0.0, 1.0])
    # s^2 = 1/3 in both groups, d = 0.25: 7.85 * (2/3) / 0.0625 = 83.7
    assert seeds_needed([noisy], [noisy + 0.25], paired=False, at_least=0.01) == 84


def test_correction_for_several_comparisons() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
