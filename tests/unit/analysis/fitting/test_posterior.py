"""Draws against posteriors that are known, or that a grid gives."""

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import norm

from scilab_rl.algorithms.models.rescorlawagner2 import RESCORLAWAGNER2
from scilab_rl.analysis.fitting import posterior
from scilab_rl.analysis.fitting.estimation import fit, natural, prior_draws
from scilab_rl.analysis.fitting.panel import make_panel
from scilab_rl.analysis.fitting.recovery import compare_with_truth
from scilab_rl.analysis.fitting.simulation import simulate


def sample(log_joint, mode, curvature, n=200):
    """Sample a posterior with one parameter for so many participants."""
    hessian = np.full((n, 1, 1), curvature)
    return posterior.sample(log_joint, np.full((n, 1), mode), hessian, np.random.default_rng(0))


def test_a_normal_posterior_is_found_though_its_curvature_is_wrong():
    found = sample(lambda z: norm.logpdf(z[..., 0], 0.5, 0.2) - 3.0, 0.5, 1.0)
    assert (found.n_effective >= posterior.ENOUGH).all()
    assert np.allclose(found.weights.sum(axis=1), 1.0)
    assert np.allclose(found.log_evidence.mean(), -3.0, atol=0.01)
    for share in (0.025, 0.5, 0.975):
        expected = norm.ppf(share, 0.5, 0.2)
        assert np.isclose(found.quantile(share).mean(), expected, atol=0.01)
        assert found.quantile(share).std() < 0.05


def test_the_tail_of_an_undetermined_parameter_is_that_of_its_prior():
    """Ten right choices of ten: the likelihood is flat from there on, and has no curvature."""
    grid = np.linspace(-6.0, 6.0, 20_001)

    def log_joint(z):
        return norm.logpdf(z) + 10 * np.log(expit(4.0 * z))

    density = np.exp(log_joint(grid))
    below = density.cumsum() / density.sum()
    mode = grid[density.argmax()]
    curvature = 1.0 + 10 * 16.0 * expit(4.0 * mode) * expit(-4.0 * mode)
    found = sample(lambda z: log_joint(z[..., 0]), mode, curvature)
    for share in (0.025, 0.975):
        exact = grid[np.searchsorted(below, share)]
        assert np.isclose(found.quantile(share).mean(), exact, atol=0.02)
    upper = mode + norm.ppf(0.975) / np.sqrt(curvature)
    assert below[np.searchsorted(grid, upper)] < 0.95  # which the curvature alone would miss
    evidence = np.log(density.sum() * (grid[1] - grid[0]))
    assert np.isclose(found.log_evidence.mean(), evidence, atol=0.01)


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    true = prior_draws(RESCORLAWAGNER2, 100, np.random.default_rng(1))
    rows = simulate(
        RESCORLAWAGNER2, natural(RESCORLAWAGNER2, true), "Bandit-drifting-a2",
        n_trials=100, seed=0,
    )  # fmt: skip
    for found in compare_with_truth(fit("rescorlawagner2", make_panel(rows)), true):
        assert 0.90 <= found.coverage <= 0.99, found.parameter
