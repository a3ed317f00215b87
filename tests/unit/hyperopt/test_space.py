from __future__ import annotations

import math

import optuna
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from scilab_rl.errors import ConfigError
from scilab_rl.hyperopt.space import (
    Parameter,
    SearchSpace,
    override_text,
    parameter_of,
    parse_space,
)


def from_command_line(text: str) -> Parameter:
    return parameter_of(OverridesParser.create().parse_override(text))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("++a.b=interval(0.9,0.99)", Parameter("++a.b", "float", 0.9, 0.99)),
        ("a=tag(log,interval(1e-5,1e-2))", Parameter("a", "float", 1e-5, 1e-2, log=True)),
        ("a=int(interval(1,8))", Parameter("a", "int", 1, 8)),
        ("a=range(1,10,2)", Parameter("a", "int", 1, 9, 2)),
        ("a=choice(1,b,[2,3])", Parameter("a", "categorical", choices=(1, "b", [2, 3]))),
        ("a=x,y", Parameter("a", "categorical", choices=("x", "y"))),
    ],
)
def test_sweeps_of_the_command_line(text: str, expected: Parameter) -> None:
    assert from_command_line(text) == expected


def test_overrides_are_read_back_as_the_same_values() -> None:
    choices = (0.25, 1e-05, None, True, "auto", "two words", "it's", [256, "a b"], {"n": [1, 2]})
    parameter = Parameter("++a", "categorical", choices=choices)
    for label, choice in zip(parameter.labels, choices, strict=True):
        parsed = OverridesParser.create().parse_override(parameter.override(label))
        assert parsed.value() == choice


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"type": "flaot", "low": 0, "high": 1}, "float, int, categorical"),
        ({"type": "float", "low": 0}, "needs low and high"),
        ({"type": "float", "low": 2, "high": 1}, "low <= high"),
        ({"type": "float", "low": 0, "high": float("nan")}, "finite bounds"),
        ({"type": "float", "low": 0, "high": 1, "log": True}, "low > 0"),
        ({"type": "float", "low": "a", "high": 1}, "needs numbers"),
        ({"type": "int", "low": 0.5, "high": 3}, "whole numbers"),
        ({"type": "int", "low": 0, "high": 3, "step": 0}, "step above 0"),
        ({"type": "categorical"}, "needs choices"),
        ({"type": "float", "lo": 0, "high": 1}, "Did you mean 'low'"),
        (3, "needs a type"),
    ],
)
def test_wrong_entries_are_named(entry: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        parse_space({"++algorithm.x": entry})
    assert "++algorithm.x" in str(error.value)


def test_values_of_a_step_include_the_upper_end() -> None:
    assert Parameter("a", "float", 0.0, 0.3, 0.1).values() == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert Parameter("a", "int", 1, 6, 2).values() == [1, 3, 5]
    assert SearchSpace([Parameter("a", "float", 0.0, 1.0)]).size() == math.inf


CONDITIONAL = SearchSpace(
    parse_space(
        {
            "algorithm": {"type": "categorical", "choices": ["sac", "td3"]},
            "++algorithm.ent_coef": {
                "type": "categorical", "choices": [0.1, 0.2], "when": {"algorithm": "sac"},
            },
        }
    )
)  # fmt: skip


def test_conditional_parameters_exist_only_where_they_belong() -> None:
    assert list(CONDITIONAL.all_settings()) == [
        {"algorithm": "sac", "algorithm.ent_coef": 0.1},
        {"algorithm": "sac", "algorithm.ent_coef": 0.2},
        {"algorithm": "td3"},
    ]
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(10):
        setting = CONDITIONAL.suggest(study.ask())
        assert ("algorithm.ent_coef" in setting) == (setting["algorithm"] == "sac")
        assert len(CONDITIONAL.overrides(setting)) == len(setting)


MIXED = SearchSpace(
    [
        Parameter("++rate", "float", 1e-4, 1e-2, log=True),
        Parameter("gamma", "float", 0.9, 0.99, step=0.01),
        Parameter("n", "int", 1, 9, 2),
        Parameter("net", "categorical", choices=([64, 64], [256], None, True)),
    ]
)


@pytest.mark.parametrize("net", [[64, 64], [256], None, True])
def test_setting_of_a_configuration_is_typed_as_the_space_has_it(net: object) -> None:
    values = {"rate": 1e-3, "gamma": 0.95, "n": 5, "net": net, "other": 1}
    setting = MIXED.setting_in(values)
    assert setting is not None
    assert setting["net"] in MIXED.parameters[3].labels
    assert setting["gamma"] in (MIXED.parameters[1].values() or [])
    words = dict(word.lstrip("+").split("=") for word in MIXED.overrides(setting))
    assert words["net"] == override_text(net)
    assert (words["rate"], words["n"]) == ("0.001", "5")


@pytest.mark.parametrize(
    "outside",
    [{"rate": 0.1}, {"gamma": 0.955}, {"n": 2}, {"n": True}, {"net": [64]}, {"net": 1},
     {"rate": "auto"}, {"rate": None}],
)  # fmt: skip
def test_configuration_outside_of_the_space_has_no_setting(outside: dict) -> None:
    values = {"rate": 1e-3, "gamma": 0.95, "n": 5, "net": [256]}
    assert MIXED.setting_in(values) is not None
    assert MIXED.setting_in(values | outside) is None
    assert MIXED.setting_in({"rate": 1e-3}) is None


def test_conditions_name_parameters_that_come_before() -> None:
    with pytest.raises(ConfigError, match="must come before"):
        SearchSpace([Parameter("a", "int", 0, 1, when={"b": 1})])
    with pytest.raises(ConfigError, match="given twice"):
        SearchSpace([Parameter("a", "int", 0, 1), Parameter("++a", "int", 0, 2)])


def test_zero_bounds_belong_to_the_description() -> None:
    described = SearchSpace([Parameter("a", "float", 0.0, 1.0)]).describe()
    assert described == {"a": {"key": "a", "kind": "float", "low": 0.0, "high": 1.0}}


def test_text_of_nested_values() -> None:
    assert override_text({"n": [1, None]}) == "{n:[1,null]}"
