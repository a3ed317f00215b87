from __future__ import annotations

import math

import pytest

from scilab_rl.errors import ConfigError
from scilab_rl.search.scores import SCORES, Curve, find_score, natural_direction, score

CURVE = Curve(steps=[100, 200, 300], values=[0.2, 0.8, 0.6], budget=400, threshold=0.7)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("final", 0.6),
        ("best", 0.8),
        # 100 steps at 0.2, 100 at 0.8, 100 at 0.6, and the last 100 of the budget at 0.6
        ("auc", 0.55),
        ("default", 0.575),
        ("steps_to_threshold", 200.0),
    ],
)
def test_scores_of_a_curve(name: str, expected: float) -> None:
    assert score(SCORES[name], CURVE) == pytest.approx(expected)


def test_reaching_the_end_early_is_worth_the_rest_of_the_budget() -> None:
    slow = Curve([100, 200, 300, 400], [0.0, 0.0, 1.0, 1.0], budget=400)
    fast = Curve([100, 200], [0.0, 1.0], budget=400)
    assert SCORES["auc"](slow) == pytest.approx(0.5)
    assert SCORES["auc"](fast) == pytest.approx(0.75)


def test_threshold_never_reached_costs_the_whole_budget() -> None:
    assert SCORES["steps_to_threshold"](Curve([100], [0.1], budget=400)) == 400.0
    assert natural_direction("steps_to_threshold") == "minimize"


@pytest.mark.parametrize("bad", [math.nan, math.inf, None, "0.5", [1.0], True])
def test_only_finite_numbers_are_scores(bad: object) -> None:
    with pytest.raises(ValueError, match="not a finite number"):
        score(lambda curve: bad, CURVE)  # type: ignore[arg-type, return-value]


def test_a_run_without_evaluation_has_no_score() -> None:
    with pytest.raises(ValueError, match="before its first evaluation"):
        score(SCORES["final"], Curve([], [], 400))


def test_own_functions_are_found_and_wrong_names_explained() -> None:
    assert find_score("statistics.median") is not None
    with pytest.raises(ConfigError, match="Did you mean 'final'"):
        find_score("finale")
    with pytest.raises(ConfigError, match="cannot be imported"):
        find_score("no_such_package.score")
