from __future__ import annotations

from pathlib import Path

import pytest
from optuna.trial import TrialState

from scilab_rl.errors import ConfigError
from scilab_rl.search.race import RaceRules
from scilab_rl.search.source import ConfigurationSource
from scilab_rl.search.space import Parameter, SearchSpace
from scilab_rl.search.storage import StudyStorage

HUGE = SearchSpace([Parameter("n", "int", 1000, 1_000_000_000)])


def source(folder: Path, space: SearchSpace, sampler: str, budget: int = 20) -> ConfigurationSource:
    return ConfigurationSource(StudyStorage(folder), space, sampler, 3, RaceRules(budget, 1, 1))


def test_a_grid_over_a_huge_range_goes_through_it_in_order(tmp_path: Path) -> None:
    asked = source(tmp_path, HUGE, "grid")
    assert asked.is_exhaustive and asked.n_left() == 999_999_001
    numbers = [asked.suggest(n) for n in range(3)]
    tried = asked.storage.configurations()
    assert [tried[n] for n in numbers if n is not None] == [{"n": n} for n in range(1000, 1003)]
    assert asked.n_left() == 999_998_998


def test_a_sampler_over_a_huge_range_lists_nothing(tmp_path: Path) -> None:
    asked = source(tmp_path, HUGE, "random")
    asked.suggest(0)
    assert not asked.is_exhaustive


def test_equal_values_that_were_computed_otherwise_are_tried_once(tmp_path: Path) -> None:
    """Optuna's 0.30000000000000004 is our 0.3."""
    space = SearchSpace([Parameter("x", "float", 0.0, 1.0, 0.1)])
    asked = source(tmp_path, space, "random", budget=5)
    for n in range(11):
        assert asked.suggest(n) is not None
    kept = [t for t in asked.storage.trials() if t.state == TrialState.RUNNING]
    assert len({round(trial.params["x"], 9) for trial in kept}) == 11
    assert asked.n_left() == 0 and asked.suggest(11) is None


def test_a_grid_needs_countable_values(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="infinitely many values"):
        source(tmp_path, SearchSpace([Parameter("x", "float", 0.0, 1.0)]), "grid")
