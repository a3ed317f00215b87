"""Behavior in a task: measures against values counted by hand, and groups next to each other."""

import csv

import numpy as np
import pytest

from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.analysis.fitting.behavior import (
    behavior_group,
    behavior_rows,
    mean_interval,
    side_by_side,
    write_behavior,
)
from scilab_rl.analysis.fitting.panel import make_panel
from scilab_rl.analysis.fitting.predictive import (
    learning_curve,
    reversal_curve,
    simulated_panel,
    size_of,
    task_behavior,
    task_curves,
)
from scilab_rl.analysis.fitting.simulation import simulate

TRUE = {"learning_rate": np.full(6, 0.5), "inverse_temperature": np.full(6, 8.0)}


def trials(*columns, names):
    """Return rows of one participant from tuples."""
    return [{"participant_id": "a", **dict(zip(names, row, strict=True))} for row in columns]


def test_reversals_are_aligned_and_do_not_reach_into_the_next():
    names = ("response", "feedback", "correct", "reversals", "block")
    rows = trials(
        (0, 1, 1, 0, 0), (0, 1, 1, 0, 0), (0, 0, 0, 1, 0), (1, 1, 1, 1, 0), (1, 0, 0, 2, 0),
        (1, 0, 0, 0, 1),
        names=names,
    )  # fmt: skip
    curve = reversal_curve(make_panel(rows))
    shares = dict(zip(curve.places.tolist(), curve.shares[0].tolist(), strict=True))
    # Before the first one two correct choices, before the second one an error and a correct one.
    assert (shares[-2.0], shares[-1.0]) == (0.5, 1.0)
    assert (shares[0.0], shares[1.0]) == (0.0, 1.0)  # errors at both; then only the first one
    assert np.isnan(shares[2.0]) and np.isnan(shares[-3.0])
    assert reversal_curve(make_panel(rows[-1:])) is None


def test_first_free_choices_of_the_horizon_task():
    names = ("response", "feedback", "forced", "horizon", "information", "block")

    def game(block, horizon, samples, points, choice, information):
        forced = [
            (r, f, 1, horizon, information, block) for r, f in zip(samples, points, strict=True)
        ]
        return [*forced, (choice, 0.5, 0, horizon, information, block)]

    rows = trials(
        *game(0, 1, (0, 0, 0, 1), (0.4, 0.4, 0.4, 0.6), 1, -2),  # right is less known: chosen
        *game(1, 6, (0, 1, 1, 1), (0.4, 0.6, 0.6, 0.6), 1, 2),  # left is less known: not chosen
        (0, 0.4, 0, 6, 2, 1),  # a later free choice does not count
        *game(2, 6, (0, 1, 0, 1), (0.3, 0.5, 0.3, 0.5), 0, 0),  # left was worse: chosen
        names=names,
    )
    found = {name: share[0] for name, share in task_behavior(make_panel(rows)).items()}
    assert found["the less known, 1 free choice"] == 1.0
    assert found["the less known, 6 free choices"] == 0.0
    assert found["the worse, 6 free choices"] == 1.0
    assert np.isnan(found["the worse, 1 free choice"])


def test_searches_are_described_by_new_cells_and_success():
    names = ("response", "feedback", "correct", "trial", "visits", "block")
    rows = trials(
        (0, 0, 1, 0, 0, 0), (1, 0, 0, 1, 1, 0), (0, 1, 1, 2, 0, 0), (0, 0, 1, 0, 0, 1), names=names
    )
    panel = make_panel(rows)
    found = task_behavior(panel)
    assert found["enters a new cell"].tolist() == [0.75]
    assert found["finds the goal"].tolist() == [0.5]
    assert size_of(panel) == (None, 2)
    assert learning_curve(panel).y_label == "share of moves into new cells"


def test_models_make_as_many_choices_as_the_people():
    rows = simulate(
        RESCORLAWAGNER, TRUE, "Bandit-reversal-a2", n_trials=30, n_blocks=3, env_kwargs=None
    )
    panel = make_panel(rows)
    assert size_of(panel) == (30, 3)
    acted = simulated_panel(RESCORLAWAGNER, TRUE, size_of(panel), "Bandit-reversal-a2", {})
    assert acted.responses.shape == panel.responses.shape
    two = make_panel([{"subjID": 1, "level1_choice": 2, "level2_choice": 3, "reward": 1}] * 7)
    assert size_of(two) == (7, 1)


def test_intervals_of_few_are_wide():
    """With two numbers, Student's t is 12.7 times the standard error."""
    mean, low, high = mean_interval(np.array([0.50, 0.52, np.nan]))
    assert np.isclose(mean, 0.51)
    assert np.isclose((low, high), (0.51 - 0.01 * 12.706, 0.51 + 0.01 * 12.706), atol=1e-3).all()
    assert mean_interval(np.array([0.0, 1.0]))[1:] == (0.0, 1.0)  # shares have bounds
    assert np.isnan(mean_interval(np.array([np.nan]))).all()
    assert np.isnan(mean_interval(np.array([0.7]))[1:]).all()


def test_a_single_one_is_measured_over_blocks():
    one = {name: values[:1] for name, values in TRUE.items()}
    rows = simulate(RESCORLAWAGNER, one, "Bandit", n_trials=20, n_blocks=4)
    group = behavior_group("agent", "an agent", make_panel(rows))
    assert (group.unit, len(group.panel.participants)) == ("blocks", 4)


@pytest.fixture(scope="module")
def groups():
    tables = [
        simulate(RESCORLAWAGNER, TRUE, "Bandit-reversal-a2", n_trials=80, seed=s) for s in (1, 2)
    ]
    return [
        behavior_group(label, "simulated", make_panel(rows))
        for label, rows in zip(("people", "model"), tables, strict=True)
    ]


def test_groups_stand_side_by_side(groups):
    columns, rows = side_by_side(groups)
    assert columns == ["behavior", "people", "model"]
    names = [row["behavior"] for row in rows]
    assert names[:2] == ["after a win", "after a loss"]
    assert "correct choices, trials since the reversal -1" in names
    assert len(names) == 2 + 3 + 3
    assert all("[" in str(row["people"]) for row in rows)


def test_reversals_are_noticed_by_learners(groups):
    curve = {curve.title: curve for curve in groups[0].curves}["Reversals"]
    shares = dict(zip(curve.places.tolist(), np.nanmean(curve.shares, axis=0), strict=True))
    assert shares[-1.0] > 0.7 > 0.5 > shares[0.0] and shares[9.0] > 0.6


def test_page_and_table_hold_all_groups(groups, tmp_path):
    page = write_behavior(groups, "Bandit-reversal-a2-v0", tmp_path).read_text()
    assert "people and model" in page and "Reversals" in page and "<script" not in page
    with (tmp_path / "behavior.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(behavior_rows(groups)) == 2 * (2 + 10 + 15)
    assert {row["n"] for row in rows if row["place"] == ""} == {"6"}


def test_a_group_without_a_curve_leaves_it_out(groups):
    rows = [{"participant_id": p, "response": p % 2, "feedback": 1} for p in (0, 1, 1)]
    assert task_curves(make_panel(rows)) == []
