from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scilab_rl.algorithms.random import RANDOM
from scilab_rl.errors import ConfigError
from scilab_rl.learning.declared import (
    declared_metrics,
    differences,
    how_to_declare,
    possible_metrics,
    recorded_metrics,
)
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.probes import answerable
from scilab_rl.testing.algorithms import AlgorithmContract


def contract(algorithm: str, **arguments: Any) -> AlgorithmContract:
    contract = AlgorithmContract()
    contract.algorithm, contract.arguments = algorithm, arguments
    return contract


# What the YAML files do not switch on; the contract test looks at them as they are.
CONFIGURATIONS = [
    ("cleansac", {"ent_coef": 0.1, "n_critics": 1, "log_obs_step": True, "log_act_step": True}),
    ("cleansacmc", {"n_critics": 1, "log_act_step": True}),
    ("sac_var", {"n_critics": 1, "weight_critic_var": 0.0, "log_obs_step": True}),
    ("sac", {"ent_coef": 0.1}),
    ("ppo", {"clip_range_vf": 0.2}),
    ("cleanppo", {"intrinsic": "icm"}),
    ("cleansac", {"intrinsic": "morphological"}),
    ("sac", {"intrinsic": "rnd"}),
    ("td3", {"intrinsic": "critic_variance"}),
]


@pytest.mark.parametrize(("algorithm", "arguments"), CONFIGURATIONS)
def test_declarations_hold_in_other_configurations(algorithm: str, arguments: dict) -> None:
    contract(algorithm, **arguments).test_records_what_it_declares()


def test_a_single_critic_and_a_fixed_temperature_of_jaxsac_record_nothing_as_zero() -> None:
    contract("jaxsac", n_critics=1, ent_coef=0.1).test_records_what_it_declares()


@pytest.mark.parametrize(
    ("algorithm", "arguments", "has_second"),
    [
        ("cleansac", {"n_critics": 1}, False),
        ("cleansac", {"n_critics": 3}, True),
        ("sac", {}, True),
        ("sac", {"policy_kwargs": {"n_critics": 1, "net_arch": [8]}}, False),
        ("ddpg", {}, False),
        ("td3", {}, True),
        ("tqc", {}, True),
        ("dqn", {}, False),
        ("cleandqn", {}, False),
        ("actor_critic", {}, False),
        ("ppo", {}, False),
    ],
)
def test_the_critics_variance_needs_a_second_one(
    algorithm: str, arguments: dict, has_second: bool
) -> None:
    model = contract(algorithm, **arguments).build()
    before = np.random.get_state()[1].tolist()
    inspector = AgentInspector(model)
    assert np.random.get_state()[1].tolist() == before
    assert ("critic_variance" in answerable(inspector)) == has_second


def test_what_a_configuration_does_not_record_is_absent_with_its_condition() -> None:
    recorded = recorded_metrics(contract("cleansac", n_critics=1, ent_coef=0.1).build())
    assert "train/target_critic_variance" not in recorded.names
    assert recorded.absent["train/target_critic_variance"] == "n_critics is above 1"
    assert recorded.absent["train/ent_coef_loss"] == "ent_coef is auto"
    both = recorded_metrics(contract("cleansac").build())
    assert {
        "train/target_critic_variance",
        "train/ent_coef_loss",
        "eval/success_rate",
    } <= both.names


class Own(RANDOM):
    metrics = ("train/bonus", ("train/rare", "it happens"))


def test_a_class_adds_to_what_it_is_made_from() -> None:
    class Further(Own):
        metrics = ("train/further",)

    names = [metric.name for metric in declared_metrics(Further)]
    assert names == ["train/further", "train/bonus", "train/rare"]
    assert {"train/rare", "train/intrinsic_reward_step"} <= possible_metrics(Further).names


def test_undeclared_and_unrecorded_metrics_are_told_with_what_to_do() -> None:
    model: Any = object.__new__(Own)
    assert differences(model, ["train/bonus"]) == []
    assert differences(model, ["train/rare", "train/bonus"]) == []
    assert differences(model, ["train/bonus", "train/new"]) == [
        'train/new is recorded and not declared. If Own records it, add "train/new" to metrics in '
        f"{__name__.replace('.', '/')}.py."
    ]
    (line,) = differences(model, [])
    assert line.startswith("train/bonus is declared in `metrics` and was not recorded.")


def test_nobody_is_told_to_change_a_library() -> None:
    assert how_to_declare(RANDOM, "train/x") == ""


def test_sac_var_needs_a_variance() -> None:
    with pytest.raises(ConfigError, match="n_critics must be at least 2"):
        contract("sac_var", n_critics=1).build()
