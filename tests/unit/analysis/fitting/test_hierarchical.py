"""Hierarchical fits: what is refused, and that the population is found."""

import sys

import numpy as np
import pytest

from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.analysis.fitting.estimation import fit
from scilab_rl.analysis.fitting.hierarchical import Posterior, sample_posterior
from scilab_rl.analysis.fitting.panel import make_panel
from scilab_rl.analysis.fitting.simulation import simulate
from scilab_rl.errors import MissingDependencyError


def posterior(r_hat=1.0, effective=1000.0, n_divergent=0):
    return Posterior(
        "rescorlawagner", RESCORLAWAGNER,
        group=np.tile([0.0, np.log(4.0)], (100, 1)), spread=np.ones((100, 2)),
        participants=np.zeros((100, 3, 2)),
        r_hat={"group": 1.0, "spread": r_hat}, effective={"group": effective, "spread": 900.0},
        n_divergent=n_divergent,
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
    panel = make_panel([{"participant_id": 1, "response": r, "feedback": 1} for r in (0, 1, 1)])
    with pytest.raises(MissingDependencyError, match=r"scilab-rl\[cognition\]"):
        sample_posterior(fit("randomchoice", panel))


@pytest.mark.slow
def test_the_population_is_found():
    pytest.importorskip("numpyro")
    rng = np.random.default_rng(0)
    true = {"bias": rng.normal(0.8, 0.3, 20)}
    panel = make_panel(simulate(_model("randomchoice"), true, "Bandit", n_trials=60, seed=0))
    found = sample_posterior(fit("randomchoice", panel), n_warmup=300, n_samples=300)
    (row,) = found.group_rows()
    assert row["low"] < true["bias"].mean() < row["high"]
    assert np.isclose(found.participants.mean(axis=(0, 1))[0], true["bias"].mean(), atol=0.15)
    assert max(found.r_hat.values()) < 1.05


def _model(name):
    from scilab_rl.analysis.fitting.estimation import find_model

    return find_model(name)
