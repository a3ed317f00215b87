"""Fits, comparisons and predictions against values computed by hand, and against the truth."""

import csv
import json

import numpy as np
import pytest

from scilab_rl.algorithms.models.hybrid import HYBRID
from scilab_rl.algorithms.models.kalmanthompson import KALMANTHOMPSON
from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.analysis.fitting import recovery, report
from scilab_rl.analysis.fitting.estimation import fit, natural, prior_draws
from scilab_rl.analysis.fitting.panel import make_panel, read_panel
from scilab_rl.analysis.fitting.predictive import learning_curve, stay_probabilities
from scilab_rl.analysis.fitting.selection import choice_probabilities, held_out, select
from scilab_rl.analysis.fitting.simulation import simulate
from scilab_rl.analysis.report import write_table
from scilab_rl.errors import ConfigError


def rows_of(*choices, **columns):
    """Return rows of one participant from (response, feedback)."""
    return [{"participant_id": "a", "response": r, "feedback": f, **columns} for r, f in choices]


@pytest.fixture(scope="module")
def learners():
    """Eight participants who learn, as rows, and their true parameters."""
    true = {"learning_rate": np.linspace(0.2, 0.7, 8), "inverse_temperature": np.full(8, 6.0)}
    rows = simulate(RESCORLAWAGNER, true, "Bandit-reversal-a2", n_trials=100, seed=0)
    return rows, true


@pytest.fixture(scope="module")
def fits(learners):
    panel = make_panel(learners[0])
    return [fit(name, panel) for name in ("rescorlawagner", "randomchoice")]


def test_what_was_seen_is_the_choice_before():
    panel = make_panel(rows_of((0, 1), (1, 0), (1, 1)))
    assert panel.seen.response.tolist() == [[0, 0, 1]]
    assert panel.seen.feedback.tolist() == [[0, 1, 0]]
    assert panel.seen.is_first.tolist() == [[True, False, False]]
    assert (panel.n_states, panel.n_actions, panel.n_stages) == (1, 2, 1)


def test_blocks_begin_anew_and_forced_choices_do_not_count():
    rows = [*rows_of((0, 1), block=0, forced=1), *rows_of((1, 0), block=1, forced=0)]
    panel = make_panel(rows)
    assert panel.seen.is_first.tolist() == [[True, True]]
    assert panel.counts.tolist() == [[0, 1]]


def test_shorter_participants_are_filled_up_with_choices_that_do_not_count():
    rows = [*rows_of((0, 1), (1, 0)), {"participant_id": "b", "response": 1, "feedback": 1}]
    panel = make_panel(rows)
    assert panel.participants == ("a", "b")
    assert panel.counts.tolist() == [[1, 1], [1, 0]]


def test_other_scales_and_names_are_understood():
    rows = [{"subjID": 1, "choice": 1, "outcome": -1}, {"subjID": 1, "choice": 2, "outcome": 1}]
    panel = make_panel(rows)
    assert panel.responses.tolist() == [[0, 1]]
    assert panel.seen.feedback.tolist() == [[0, 0]]  # -1 is 0, and what comes last is not seen
    points = make_panel(rows_of((0, 40), (1, 60)))
    assert points.seen.feedback.tolist() == [[0, 0.4]]


def test_a_row_per_trial_of_a_two_step_task_becomes_two():
    rows = [{"subjID": 1, "level1_choice": 2, "level2_choice": 3, "reward": 1}]
    panel = make_panel(rows)
    assert panel.seen.state.tolist() == [[0, 2]]
    assert panel.responses.tolist() == [[1, 0]]
    assert panel.n_stages == 2


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"participant_id": 1, "responses": 1, "feedback": 0}], "Did you mean 'responses'"),
        (rows_of(("left", 1)), "has 'left', not a number"),
        (rows_of((0.5, 1), (0, 1)), "whole numbers"),
    ],
)
def test_unusable_tables_are_refused(rows, message):
    with pytest.raises(ConfigError, match=message):
        make_panel(rows)


def test_a_table_is_read_as_it_was_written(tmp_path, learners):
    write_table(learners[0], tmp_path / "choices.csv")
    panel, read = make_panel(learners[0]), read_panel(tmp_path / "choices.csv")
    assert np.array_equal(panel.responses, read.responses)
    assert np.array_equal(panel.seen.feedback, read.seen.feedback)


def test_a_bias_is_estimated_as_the_log_odds():
    panel = make_panel(rows_of(*[(0, 1)] * 30, *[(1, 1)] * 10))
    found = fit("randomchoice", panel, method="mle")
    assert np.isclose(found.values["bias"][0], np.log(3.0), atol=1e-6)
    assert np.isclose(found.log_likelihood[0], 30 * np.log(0.75) + 10 * np.log(0.25))
    half = 1.959964 / np.sqrt(40 * 0.75 * 0.25)
    assert np.allclose(found.intervals["bias"], [[np.log(3.0) - half], [np.log(3.0) + half]])
    assert np.isclose(found.bic[0], -2 * found.log_likelihood[0] + np.log(40))
    assert found.converged.all()


def test_the_prior_draws_estimates_towards_its_mean():
    panel = make_panel(rows_of(*[(0, 1)] * 30, *[(1, 1)] * 10))
    found = fit("randomchoice", panel)
    # The slope of the posterior is zero: 30 - 40 sigmoid(b) - b = 0.
    b = found.values["bias"][0]
    assert np.isclose(30 - 40 / (1 + np.exp(-b)), b, atol=1e-6)
    assert np.isfinite(found.log_evidence[0]) and found.log_evidence[0] < found.log_likelihood[0]
    assert found.n_effective[0] > 200


def test_parameters_of_simulated_participants_are_found(fits, learners):
    found, true = fits[0], learners[1]
    low, high = found.intervals["learning_rate"]
    inside = (low <= true["learning_rate"]) & (true["learning_rate"] <= high)
    assert found.converged.all() and inside.sum() >= 6
    assert np.corrcoef(found.values["learning_rate"], true["learning_rate"])[0, 1] > 0.6
    assert (found.n_agreeing >= 2).all()


def test_the_likelihood_is_the_product_of_the_choice_probabilities(fits):
    found = fits[0]
    each = choice_probabilities(found.model, found.panel, found.values)
    chosen = np.take_along_axis(each, found.panel.responses[..., None], axis=2)[..., 0]
    assert np.allclose(np.log(chosen).sum(axis=1), found.log_likelihood, atol=1e-3)


def test_learners_are_told_from_those_who_do_not_learn(fits):
    tests = [held_out(found) for found in fits]
    assert (tests[0].log_probability > tests[1].log_probability).all()
    assert tests[0].accuracy.mean() > 0.75
    chosen = select(np.stack([found.log_evidence for found in fits], axis=1))
    assert chosen.protected[0] > 0.95 and np.isclose(chosen.protected.sum(), 1.0)


def test_equal_models_stay_undecided():
    chosen = select(np.tile([-10.0, -10.0, -10.0], (20, 1)))
    assert np.allclose(chosen.frequencies, 1 / 3)
    assert chosen.p_equal > 0.5
    assert np.allclose(chosen.protected, 1 / 3, atol=0.02)


def test_repeated_choices_are_counted_by_what_they_brought():
    panel = make_panel(rows_of((0, 1), (0, 0), (1, 1), (1, 0), (1, 0)))
    stays = stay_probabilities(panel)
    assert stays["after a win"].tolist() == [1.0]
    assert stays["after a loss"].tolist() == [0.5]


def test_planners_change_after_a_rare_reward():
    steps = [(0, 0, 0, 0), (1, 2, 0, 1), (0, 0, 1, 0), (1, 2, 0, 0), (0, 0, 1, 0), (1, 2, 0, 0)]
    rows = [
        {"participant_id": "a", "stage": g, "state": s, "response": r, "feedback": f}
        for g, s, r, f in steps
    ]
    stays = stay_probabilities(make_panel(rows))
    assert stays["paid, rare"].tolist() == [0.0]  # response 0 led to state 2; then response 1
    assert stays["not paid, common"].tolist() == [1.0]
    assert np.isnan(stays["paid, common"][0])


def test_a_learning_curve_counts_correct_choices():
    rows = rows_of((0, 1), (0, 1), forced=0)
    rows = [row | {"trial": index, "correct": index} for index, row in enumerate(rows)]
    curve = learning_curve(make_panel(rows))
    assert curve.places.tolist() == [0.5, 1.5] and curve.shares.tolist() == [[0.0, 1.0]]
    assert learning_curve(make_panel(rows_of((0, 1)))) is None


def test_simulated_participants_are_the_same_for_the_same_seed():
    true = natural(HYBRID, prior_draws(HYBRID, 2, np.random.default_rng(0)))
    one, two = (simulate(HYBRID, true, "TwoStep", n_trials=10, seed=s) for s in (3, 3))
    assert one == two and len(one) == 2 * 2 * 10
    games = simulate(
        RESCORLAWAGNER, {"learning_rate": [0.3], "inverse_temperature": [5.0]}, "Horizon",
        n_trials=3, env_kwargs={"horizon": 6},
    )  # fmt: skip
    assert [row["block"] for row in games] == [0] * 10 + [1] * 10 + [2] * 10


def test_acting_and_fitting_may_take_turns():
    """They compute in float32 and float64, in one process."""
    true = {"observation_sd": np.full(2, 0.4), "drift_sd": np.full(2, 0.1)}
    for _ in range(2):
        rows = simulate(KALMANTHOMPSON, true, "Bandit-drifting-a3", n_trials=20)
        assert fit("kalmanthompson", make_panel(rows)).converged.all()


def test_a_recovery_is_kept_and_named(tmp_path):
    models = ("winstayloseshift", "randomchoice")
    result = recovery.recover(models, "Bandit-reversal-a2", n_participants=12, n_trials=100)
    assert np.allclose(result.confusion.sum(axis=1), 1.0)
    assert np.trace(result.confusion) > 1.5
    by_name = {found.parameter: found for found in result.parameters}
    assert by_name["bias"].correlation > 0.9
    page = report.write_recovery(result, tmp_path)
    assert "Recovery of winstayloseshift" in page.read_text()
    assert "recovered in Bandit-reversal-a2 with 100 trials" in recovery.sentence(
        "randomchoice", 80, tmp_path
    )
    assert "no recovery is known" in recovery.sentence("hybrid", 80, tmp_path)


def test_the_page_says_what_follows(tmp_path, learners, fits):
    results = report.fit_all(
        fits[0].panel, ("rescorlawagner", "randomchoice"), env="Bandit-reversal-a2", base=tmp_path
    )
    assert "rescorlawagner is the most frequent model of 8" in report.conclusions(results)[0]
    page = report.write_fit(results, tmp_path / "fit", "People")
    assert "Reversals" in page.read_text() and "<script" not in page.read_text()
    with (tmp_path / "fit" / "participants.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 * 3 and rows[0]["participant_id"] == "p000"


def test_the_command_fits_a_table(tmp_path, monkeypatch, capsys, learners):
    from scilab_rl.cli import fit as command

    monkeypatch.chdir(tmp_path)
    write_table(learners[0], tmp_path / "choices.csv")
    words = ["choices.csv", "model=rescorlawagner,randomchoice", "--json"]
    assert command.main(words) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [row["model"] for row in printed["models"]] == ["rescorlawagner", "randomchoice"]
    for words, message in (
        (["choices.csv"], "model=NAME"),
        (["choices.csv", "model=rescorlawagnr"], "Did you mean 'rescorlawagner'"),
        (["choices.csv", "model=cleansac"], "no likelihood of choices"),
        (["choices.csv", "model=hybrid"], "use model=rescorlawagner"),
        (["nothing.csv", "model=hybrid"], "There is no table"),
        (["choices.csv", "modle=hybrid"], "Did you mean 'model'"),
        (["choices.csv", "model=hybrid", "method=ml"], "map or mle"),
        (["choices.csv", "model=hybrid", "--arviz"], "add hierarchical=true"),
    ):
        with pytest.raises(ConfigError, match=message):
            command.main(words)
