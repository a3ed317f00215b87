"""The keys of performance tests, and what is said about wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from scilab_rl.acceptance.conditions import (
    KEY,
    RULES,
    Conditions,
    performance_tests,
    read_conditions,
    select,
    stated,
)
from scilab_rl.acceptance.rules import ReferenceRule, SequentialTest
from scilab_rl.errors import ConfigError

BASELINES = Path(__file__).parents[3] / "baselines"
GIVEN = {"eval_columns": "eval/success_rate", "eval_value": 0.9, "max_steps": 10_000}
REFERENCE = {"total_runs": 3, "succ_runs": 2, **GIVEN}


def test_the_default_is_a_sequential_test() -> None:
    conditions = read_conditions(GIVEN, "t")
    assert conditions.make_rule() == SequentialTest(0.9, 0.1, limits=(0, 1))
    assert conditions.stop_value == pytest.approx(0.95)
    assert read_conditions([GIVEN], "t") == conditions  # a list with one entry


@pytest.mark.parametrize("rule", [{}, {"rule": "reference"}, {"rule": None}])
def test_a_file_of_2024_is_decided_by_its_rule(rule: dict) -> None:
    old = read_conditions({**REFERENCE, "total_runs": 5, "succ_runs": 1, **rule}, "t")
    assert old.make_rule() == ReferenceRule(0.9, 1, 5)
    assert old.stop_value == 0.9


def test_the_command_line_chooses_another_rule() -> None:
    changed = read_conditions({**REFERENCE, "succ_runs": 1}, "t", rule="sequential")
    assert changed == read_conditions(GIVEN, "t")
    assert read_conditions({**GIVEN, "margin": 0.2}, "t", rule="reference").rule == "reference"


@pytest.mark.parametrize("key", ["total_runs", "succ_runs", "margin", "alpha", "min_runs",
                                 "max_runs", "n_episodes"])  # fmt: skip
@pytest.mark.parametrize("rule", RULES)
def test_a_key_counts_or_is_refused(rule: str, key: str) -> None:
    """No key of a rule is ignored."""
    value = {"margin": 0.05, "alpha": 0.01, "succ_runs": 1}.get(key, 7)
    plain, given = {**GIVEN, "rule": rule}, {**GIVEN, "rule": rule, key: value}
    try:
        changed = read_conditions(given, "t")
    except ConfigError as error:
        assert f"rule={rule} does not use {key}" in str(error)
        return
    before = read_conditions(plain, "t")
    assert (changed.make_rule(), changed.n_episodes) != (before.make_rule(), before.n_episodes)


@pytest.mark.parametrize("name", performance_tests())
def test_shipped_tests_set_what_they_use(name: str) -> None:
    given = OmegaConf.to_container(OmegaConf.load(performance_tests()[name]).get(KEY))
    assert read_conditions(given, name).rule == given.get("rule", "sequential")


def test_the_margin_of_a_reward_is_a_tenth_of_it() -> None:
    conditions = Conditions(-160, 1000, "eval/mean_reward")
    assert conditions.width == 16
    assert conditions.stop_value == -152


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sucs_runs": 2}, "Did you mean 'succ_runs'?"),
        ({"eval_value": None}, "requires eval_value"),
        ({"max_steps": 0}, "max_steps must be a whole number from 1"),
        ({"succ_runs": 4}, r"succ_runs \(4\) must not be above total_runs"),
        ({"margin": 0.2, "succ_runs": 2}, "rule=reference does not use margin"),
        ({"eval_value": 1.2}, "must be at most 1"),
        ({"eval_value": 0.1}, "more than the margin"),
        ({"rule": "sometimes"}, "must be one of sequential, reference"),
        ({"margin": 0}, "a number above 0"),
        ({"alpha": 0.7}, "between 0 and 0.5"),
        ({"max_runs": 2}, "must not be below min_runs"),
        ({"eval_columns": "train/loss"}, "one of eval/success_rate"),
        ({"eval_columns": "eval/sucess_rate"}, "Did you mean 'eval/success_rate'"),
        ({"tier": "weekly"}, "one of pr, nightly, release"),
        ({"n_episodes": "many"}, "n_episodes must be a whole number"),
    ],
)
def test_mistakes_are_named(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_conditions({**GIVEN, **change}, "FetchReach/sac_her-test")


def test_no_mapping_is_no_condition() -> None:
    with pytest.raises(ConfigError, match="must be a mapping"):
        read_conditions("0.9", "t")


def test_every_row_of_the_reference_is_there() -> None:
    names = set(performance_tests())
    for group, tests in {
        "FetchReach": "sac_her cleansac_her td3_her ddpg_her dense-ppo dense-cleanppo",
        "FetchPush": "sac_her cleansac_her",
        "FetchPickAndPlace": "sac_her",
        "FetchSlide": "sac_her",
        "Blocks": " ".join(
            f"{task}-{algorithm}"
            for task in ("o0-random", "o1-none", "o1-above", "o1-random")
            for algorithm in ("sac_her", "cleansac_her")
        ),
        "Parking": "limited-sac_her limited-cleansac_her",
        "PointGym": "small_open-cleansac_her medium_custom-cleansac_her",
        "PointObjGym": "o4-cleansac_her",
        "AntGym": "small_open-cleansac_her small_open-long-cleansac_her",
        "MetaW-drawer-close": "ppo cleanppo",
        "MetaW-pick-place": "sac",
        "CartPole": "dqn cleandqn cleanppo onestepac",
        "LunarLander": "dqn cleandqn",
        "MountainCar": "dqn cleandqn",
        "BipedalWalker": "ppo cleanppo",
        "Reach1DOF": "actor_critic",
    }.items():
        assert {f"{group}/{test}-test" for test in tests.split()} <= names


def test_tests_are_selected_by_name_and_tier() -> None:
    assert "FetchReach/sac_her-test" in select(["fetchreach"], None)
    pr, nightly, everything = (set(select([], tier)) for tier in ("pr", "nightly", None))
    assert pr < nightly < everything
    with pytest.raises(ConfigError, match="No performance test matches 'FetchReech'"):
        select(["FetchReech"], None)


@pytest.mark.parametrize("name", performance_tests())
def test_each_shipped_test_has_a_stored_result_or_says_what_it_costs(name):
    hours = stated(performance_tests()[name], "hours")
    assert (BASELINES / f"{name}.json").is_file() != isinstance(hours, (int, float))
