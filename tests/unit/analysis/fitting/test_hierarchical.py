"""Hierarchical fits: what is refused, and that the population is found."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.analysis.fitting.estimation import fit
from scilab_rl.analysis.fitting.hierarchical import Posterior, sample_posterior
from scilab_rl.analysis.fitting.inference_data import (
    import_arviz,
    leave_one_out,
    make_inference_data,
    write_inference_data,
)
from scilab_rl.analysis.fitting.panel import make_panel
from scilab_rl.analysis.fitting.simulation import simulate
from scilab_rl.errors import MissingDependencyError

PANEL = make_panel(
    [{"participant_id": 1, "response": r, "feedback": f} for r, f in ((0, 1), (0, 0), (1, 1))]
)


def posterior(r_hat=1.0, effective=1000.0, n_divergent=0):
    return Posterior(
        "rescorlawagner", RESCORLAWAGNER, PANEL,
        group=np.tile([0.0, np.log(4.0)], (4, 25, 1)), spread=np.ones((4, 25, 2)),
        participants=np.zeros((4, 25, 1, 2)),
        statistics={"diverging": np.arange(100).reshape(4, 25) < n_divergent},
        r_hat={"group": 1.0, "spread": r_hat}, effective={"group": effective, "spread": 900.0},
    )  # fmt: skip


def test_bad_samples_allow_no_conclusion():
    assert posterior().problem == ""
    assert posterior(r_hat=1.02).problem == "R-hat is 1.020, above 1.01"
    assert posterior(effective=100).problem == "an effective sample size is 100, below 400"
    assert "3 transitions diverged" in posterior(n_divergent=3).problem
    assert "R-hat" in posterior(r_hat=float("nan")).problem


def test_group_means_are_on_the_scale_of_the_parameter():
    rate, temperature = posterior().group_rows()
    assert (rate["group mean"], rate["low"], rate["high"]) == (0.5, 0.5, 0.5)
    assert np.isclose(temperature["group mean"], 4.0)


def test_without_numpyro_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "numpyro", None)
    with pytest.raises(MissingDependencyError, match=r"scilab-rl\[cognition\]"):
        sample_posterior(fit("randomchoice", PANEL))


def test_arviz_opens_what_was_sampled(tmp_path):
    arviz = pytest.importorskip("arviz")
    found = posterior()
    rng = np.random.default_rng(0)
    found = replace(found, participants=rng.normal(0.0, 0.3, found.participants.shape))
    data = make_inference_data(found)
    write_inference_data(data, tmp_path / "samples.nc")
    opened = arviz.from_netcdf(tmp_path / "samples.nc")
    assert {"posterior", "sample_stats", "log_likelihood", "observed_data"} <= set(opened.groups())
    assert opened.observed_data["response"].values.tolist() == [0, 0, 1]
    rate = opened.posterior["learning_rate"]
    assert rate.dims == ("chain", "draw", "participant") and rate.shape == (4, 25, 1)
    assert np.allclose(rate, 1 / (1 + np.exp(-found.participants[..., 0])))
    # The first choice is chance. The second: alpha (1 - 0.5) more for the first response.
    alpha, beta = rate.values[..., 0], np.exp(found.participants[..., 0, 1])
    each = opened.log_likelihood["response"].values
    assert np.allclose(each[..., 0], np.log(0.5), atol=1e-6)
    assert np.allclose(each[..., 1], -np.log1p(np.exp(-beta * alpha * 0.5)), atol=1e-5)
    opened.close()


def test_loo_is_that_of_importance_sampling_without_a_choice():
    pytest.importorskip("arviz")
    rng = np.random.default_rng(0)
    found = replace(
        posterior(),
        participants=rng.normal(0.0, 0.3, (4, 250, 1, 2)), group=rng.normal(size=(4, 250, 2)),
        spread=rng.uniform(size=(4, 250, 2)), statistics={"diverging": np.zeros((4, 250), bool)},
    )  # fmt: skip
    data = make_inference_data(found)
    result = leave_one_out(found, data)
    likelihood = np.exp(data.log_likelihood["response"].values.reshape(1000, 3))
    expected = np.log(1 / (1 / likelihood).mean(axis=0)).sum()  # weights are 1 / likelihood
    assert np.isclose(result.elpd, expected, atol=0.01)
    assert (result.n_choices, result.n_bad) == (3, 0)


def test_without_arviz_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(MissingDependencyError, match=r"arviz is needed .*scilab-rl\[cognition\]"):
        import_arviz()


@pytest.mark.slow
def test_the_population_is_found():
    pytest.importorskip("numpyro")
    rng = np.random.default_rng(0)
    true = {"bias": rng.normal(0.8, 0.3, 20)}
    panel = make_panel(simulate(_model("randomchoice"), true, "Bandit", n_trials=60, seed=0))
    found = sample_posterior(fit("randomchoice", panel), n_warmup=300, n_samples=300)
    (row,) = found.group_rows()
    assert row["low"] < true["bias"].mean() < row["high"]
    assert np.isclose(found.participants.mean(axis=(0, 1, 2))[0], true["bias"].mean(), atol=0.15)
    assert max(found.r_hat.values()) < 1.05


def _model(name):
    from scilab_rl.analysis.fitting.estimation import find_model

    return find_model(name)
