"""What an experiment says before it trains, which runs it reuses, and how far it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scilab_rl.analysis.estimates import detectable_difference, permutation_test
from scilab_rl.analysis.experiments import ExperimentState, PlannedGroup, power_of
from scilab_rl.analysis.groups import RunRecord

CONFIG = {"algorithm.gamma": "0.9", "n_epochs": "3", "eval_after_n_steps": "100"}


@pytest.mark.parametrize(
    ("n_seeds", "n_groups", "expected"),
    [
        (1, 2, "1 seed cannot decide: 1 run against 1 give p = 1 at best. From 4 seeds"),
        (3, 2, "3 seeds cannot decide: 3 runs against 3 give p = 0.1 at best. From 4 seeds"),
        (4, 2, "4 runs against 4 give p = 0.029 at best"),  # 2 / 70
        (4, 3, "4 seeds cannot decide: 4 runs against 4 give p = 0.057 at best. From 5 seeds"),
        (5, 2, "5 runs against 5 give p = 0.0079 at best; a difference of 2.0 standard"),
        (10, 2, "1.3 standard deviations"),
    ],
)
def test_what_seeds_can_decide_is_said_before(n_seeds: int, n_groups: int, expected: str) -> None:
    assert expected in power_of(n_seeds, n_groups)


@pytest.mark.parametrize("n", [4, 6])
def test_the_detectable_difference_is_found_in_four_of_five_experiments(n: int) -> None:
    rng, gap = np.random.default_rng(1), detectable_difference(n, 0.05)
    found = [
        permutation_test([rng.normal(size=n)], [rng.normal(gap, size=n)], paired=False) <= 0.05
        for _ in range(400)
    ]
    assert np.mean(found) == pytest.approx(0.8, abs=0.06)


def record(status: str, **config: str) -> RunRecord:
    return RunRecord(
        Path("x"), "E", "E", "sac", 1, status, (100,), {}, 300, 1.0, {**CONFIG, **config}
    )


def test_a_run_to_its_end_is_reused_whenever_it_would_have_stopped() -> None:
    fair = PlannedGroup("a", (), {**CONFIG, "early_stop_last_n": "4"}, "x", (1,), ())
    assert fair.has(record("finished", early_stop_last_n="3", early_stop_threshold="0.9"))
    assert not fair.has(record("solved", early_stop_last_n="3"))
    assert not fair.has(record("finished", n_epochs="4"))
    chosen = PlannedGroup("a", (), {**CONFIG, "early_stop_last_n": "4"}, "x", (1,), (), True)
    assert chosen.has(record("solved", early_stop_last_n="4"))
    assert not chosen.has(record("finished", early_stop_last_n="3"))


def test_the_time_left_counts_steps_of_running_runs() -> None:
    state = ExperimentState([("a, seed 1", 1000), ("b, seed 1", 1000), ("a, seed 2", 1000)])
    assert state.lines(5.0) == ["0 of 3 runs, time left not known yet"]
    state.steps = {0: 1000, 1: 500}
    state.ended = {0}
    assert state.lines(600.0) == [
        "1 of 3 runs, about 10 min left",
        "  b, seed 1: 500 of 1,000 steps",
    ]
    state.ended = {0, 1, 2}
    assert state.lines(900.0) == ["3 of 3 runs, last runs"]
