from __future__ import annotations

import math

import pytest

from scilab_rl.search.race import (
    DONE,
    RUN,
    SUGGEST,
    WAIT,
    Decision,
    Entry,
    RaceRules,
    half_width,
    may_still_be_best,
    next_action,
    spread_of,
    student_quantile,
    winner,
)

from . import simulation

RULES = RaceRules(budget=20, min_runs=2, max_runs=6)


def test_rungs_double_and_end_at_the_most_runs() -> None:
    assert RaceRules(64, 3, 12).rungs() == [3, 6, 12]
    assert RaceRules(64, 2, 7).rungs() == [2, 4, 7]
    assert RaceRules(64, 3, 3).rungs() == [3]


def test_first_repeats_come_before_new_configurations() -> None:
    assert next_action([], RULES, n_used=0, n_left=math.inf) == Decision(SUGGEST)
    assert next_action([Entry(0, n_running=1)], RULES, n_used=1, n_left=math.inf) == Decision(
        RUN, 0
    )
    assert next_action([Entry(0, n_running=2)], RULES, n_used=2, n_left=math.inf) == Decision(
        SUGGEST
    )


def test_eliminated_configurations_get_nothing() -> None:
    out = Entry(0, (0.9,), eliminated=True)
    assert next_action([out], RULES, n_used=1, n_left=0) == Decision(DONE)


def test_explores_with_half_of_the_budget_and_then_races() -> None:
    entries = [Entry(0, (0.5, 0.7)), Entry(1, (0.4, 0.7)), Entry(2, (0.0, 0.1))]
    assert next_action(entries, RULES, n_used=9, n_left=math.inf) == Decision(SUGGEST)
    assert next_action(entries, RULES, n_used=10, n_left=math.inf) == Decision(RUN, 0)


def test_a_space_that_fits_is_tried_before_the_race() -> None:
    entries = [Entry(0, (0.5, 0.7)), Entry(1, (0.4, 0.7)), Entry(2, (0.0, 0.1))]
    ask = next_action(entries, RULES, n_used=10, n_left=1, try_all=True)
    assert ask == Decision(SUGGEST)
    assert next_action(entries, RULES, n_used=10, n_left=0, try_all=True) == Decision(RUN, 0)


def test_a_promoted_setting_runs_to_its_next_rung() -> None:
    entries = [Entry(0, (0.5, 0.7), n_running=1), Entry(1, (0.4, 0.7))]
    assert next_action(entries, RULES, n_used=10, n_left=math.inf) == Decision(RUN, 0)


def test_an_undisputed_leader_earns_no_repeats() -> None:
    entries = [Entry(0, (0.90, 0.91)), Entry(1, (0.10, 0.11)), Entry(2, (0.20, 0.21))]
    assert next_action(entries, RULES, n_used=12, n_left=0) == Decision(DONE)
    assert next_action(entries, RULES, n_used=12, n_left=5) == Decision(SUGGEST)


def test_budget_ends_everything() -> None:
    entries = [Entry(0, (0.5,), n_running=1), Entry(1, (0.4, 0.5))]
    assert next_action(entries, RULES, n_used=20, n_left=5) == Decision(WAIT)
    finished = [Entry(0, (0.5, 0.5)), Entry(1, (0.4, 0.5))]
    assert next_action(finished, RULES, n_used=20, n_left=5) == Decision(DONE)


def test_last_runs_go_to_contenders_when_no_new_setting_fits() -> None:
    entries = [Entry(0, (0.5, 0.7)), Entry(1, (0.4, 0.7)), Entry(2, (0.4, 0.6))]
    assert next_action(entries, RULES, n_used=19, n_left=math.inf) == Decision(RUN, 0)


def test_without_racing_every_setting_gets_the_same() -> None:
    rules = RaceRules(budget=20, min_runs=2, max_runs=6, racing=False)
    entries = [Entry(0, (0.5, 0.7)), Entry(1, (0.4, 0.7))]
    assert next_action(entries, rules, n_used=18, n_left=math.inf) == Decision(SUGGEST)
    assert next_action(entries, rules, n_used=18, n_left=0) == Decision(DONE)


def test_interval_pools_the_deviation_of_all_configurations() -> None:
    # Both pairs deviate by 0.1 from their means: pooled variance (4 * 0.01) / 2 = 0.02.
    entries = [Entry(0, (0.4, 0.6)), Entry(1, (0.7, 0.9))]
    expected = student_quantile(0.95, 2) * math.sqrt(0.02 / 2)
    assert half_width(entries[0], spread_of(entries, RULES)) == pytest.approx(expected)
    assert student_quantile(0.95, 2) == pytest.approx(2.920, abs=1e-3)
    assert half_width(Entry(0, (0.4,)), spread_of([Entry(0, (0.4,))], RULES)) == math.inf


@pytest.mark.parametrize(
    ("degrees", "expected"), [(1, 6.3138), (2, 2.9200), (3, 2.3534), (5, 2.0150), (30, 1.6973)]
)
def test_quantile_agrees_with_the_printed_table(degrees: int, expected: float) -> None:
    assert student_quantile(0.95, degrees) == pytest.approx(expected, abs=5e-5)


def test_minimising_turns_everything_around() -> None:
    rules = RaceRules(20, 2, 6, maximize=False)
    entries = [Entry(0, (0.90, 0.91)), Entry(1, (0.10, 0.11)), Entry(2, (0.20, 0.21))]
    assert winner(entries, rules) == entries[1]
    assert may_still_be_best(entries, rules) == [entries[1]]


def test_a_lucky_run_does_not_beat_a_proven_setting() -> None:
    lucky, proven = Entry(0, (0.90, 0.72)), Entry(1, (0.8,) * 6 + (0.7, 0.9))
    assert lucky.mean > proven.mean
    assert winner([lucky, proven], RULES) == proven


def test_negative_scores_never_lose_to_failures() -> None:
    bad, failed = Entry(0, (-50.0, -49.0)), Entry(1, (), eliminated=True)
    assert winner([bad, failed], RULES) == bad
    assert winner([failed], RULES) is None


@pytest.mark.parametrize("toy", [simulation.PAPER, simulation.WIDE], ids=lambda toy: toy.name)
def test_finds_the_right_setting_more_often_with_fewer_runs(toy: simulation.Toy) -> None:
    """100 simulated studies: `python -m tests.unit.search.simulation` prints 1000."""
    race = [simulation.simulate_race(toy, seed) for seed in range(100)]
    reference = [simulation.simulate_reference(toy, seed) for seed in range(100)]
    assert simulation.rate_of(race, toy) >= simulation.rate_of(reference, toy) + 0.15
    assert simulation.mean_runs(race) < simulation.mean_runs(reference)


def test_spends_a_fraction_when_one_setting_is_far_ahead() -> None:
    outcomes = [simulation.simulate_race(simulation.EASY, seed) for seed in range(100)]
    assert simulation.rate_of(outcomes, simulation.EASY) >= 0.99
    assert simulation.mean_runs(outcomes) < 0.4 * simulation.EASY.rules.budget
