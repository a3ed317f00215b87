from __future__ import annotations

import itertools
import math
from dataclasses import replace

import optuna
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from scilab_rl.errors import ConfigError
from scilab_rl.search.parsing import parameter_of, parse_space, refuse_endless_grid
from scilab_rl.search.space import Parameter, SearchSpace
from scilab_rl.search.values import override_text, same_value, shown_text


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
        ("a=range(1,1000000000)", Parameter("a", "int", 1, 999_999_999, 1)),
        ("a=range(10,1,-3)", Parameter("a", "int", 4, 10, 3)),
        ("a=range(0,1,0.25)", Parameter("a", "float", 0.0, 0.75, 0.25)),
    ],
)
def test_sweeps_of_the_command_line(text: str, expected: Parameter) -> None:
    assert from_command_line(text) == expected


def test_overrides_are_read_back_as_the_same_values() -> None:
    choices = (0.25, 1e-05, None, True, "auto", "two words", "it's", [256, "a b"], {"n": [1, 2]},
               "true", "NULL", "inf", "1", 1, "[256]", [256])  # fmt: skip
    parameter = Parameter("++a", "categorical", choices=choices)
    assert len({*parameter.labels}) == len(choices)  # Optuna takes 1 and true for the same
    for label, choice in zip(parameter.labels, choices, strict=True):
        parsed = OverridesParser.create().parse_override(parameter.override(label)).value()
        assert parsed == choice and type(parsed) is type(choice)


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
        ({"type": "int", "low": 1, "high": 2**60}, r"up to 2\^53"),
        ({"type": "int", "low": 1, "high": 10**400}, "finite bounds"),
        ({"type": "float", "low": -1e308, "high": 1e308}, "finite bounds"),
        ({"type": "int", "low": True, "high": 3}, "there is true"),
        ({"type": "float", "low": 0, "high": 1, "log": "no"}, "true or false as log"),
        ({"type": "float", "low": 0, "high": 1, "choices": [1]}, "has no choices"),
        ({"type": "float", "low": 0, "high": 1, "when": ["a"]}, "a mapping of keys"),
        ({"type": "categorical", "choices": [1, 2], "low": 0}, "has no low"),
        ({"type": "categorical", "choices": "abc"}, "a list as choices"),
        ({"type": "categorical", "choices": [1, 1.0]}, "twice among its choices: 1 and 1.0"),
        ({"type": "categorical", "choices": [float("nan")]}, "nan among"),
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
    assert list(Parameter("a", "float", 0.0, 0.3, 0.1).values()) == [0.0, 0.1, 0.2, 0.3]
    assert list(Parameter("a", "int", 1, 6, 2).values()) == [1, 3, 5]
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
    assert setting["gamma"] in list(MIXED.parameters[1].values())
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


def test_values_are_compared_as_values() -> None:
    assert same_value(1, 1.0) and same_value(0.1 + 0.2, 0.3) and same_value([1, None], (1.0, None))
    different = (1, True, "1", "true", None, "null", [1], "[1]", {"a": 1}, {"a": True})
    for i, one in enumerate(different):
        assert [same_value(one, other) for other in different].index(True) == i
        assert sum(same_value(one, other) for other in different) == 1


def space_with_condition(choices: list, value: object) -> SearchSpace:
    return SearchSpace(
        parse_space(
            {
                "++a": {"type": "categorical", "choices": choices},
                "b": {"type": "int", "low": 0, "high": 4, "when": {"++a": value}},
            }
        )
    )


@pytest.mark.parametrize(
    ("choices", "value"),
    [([[64, 64], [256]], [64, 64]), ([True, False], False), ([1, 2], 1.0), ([None, 1], None),
     (["true", True], True), ([1, True], True), (["auto", 0.1], "auto"), ([{"n": 1}, 2], {"n": 1})],
)  # fmt: skip
def test_conditions_hold_at_their_value(choices: list, value: object) -> None:
    space = space_with_condition(choices, value)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    drawn = [space.suggest(study.ask()) for _ in range(20)]
    holds = [same_value(choices[space.parameters[0].labels.index(s["a"])], value) for s in drawn]
    assert True in holds and False in holds
    assert [("b" in setting) for setting in drawn] == holds
    assert space.size() == len(list(space.all_settings())) == 6


@pytest.mark.parametrize(
    ("choices", "value", "message"),
    [
        (["auto", 0.1], "Auto", r"is Auto, which it never is\. Did you mean 'auto'\? 'a' can be"),
        ([True, False], "true", "'true', which it never is.*can be true, false"),
        ([True, False], 1, "is 1, which it never is"),
        ([None, 1], "null", "'null', which it never is"),
        ([[64, 64]], [64, 65], r"Did you mean '\[64,64\]'"),
        ([1, 2, 3], [1, 2], "never"),
    ],
)
def test_conditions_that_never_hold_are_refused(choices: list, value: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        space_with_condition(choices, value)


@pytest.mark.parametrize(
    ("parent", "value", "holds"),
    [
        (Parameter("a", "int", 1, 9, 2), 3.0, True),
        (Parameter("a", "int", 1, 9, 2), 4, False),
        (Parameter("a", "int", 1, 9, 2), 11, False),
        (Parameter("a", "int", 1000, 1_000_000_000), 70_000, True),
        (Parameter("a", "int", 1, 9), True, False),
        (Parameter("a", "float", 0.0, 1.0, 0.1), 0.3, True),
        (Parameter("a", "float", 0.0, 1.0, 0.1), 0.35, False),
        (Parameter("a", "float", 0.0, 1.0), "0.5", False),
        (Parameter("a", "float", 0.0, 1.0), math.nan, False),
    ],
)
def test_conditions_on_ranges(parent: Parameter, value: object, holds: bool) -> None:
    child = Parameter("b", "int", 0, 1, when={"a": value})
    if holds:
        assert SearchSpace([parent, child]).size() == parent.count() + 1
    else:
        with pytest.raises(ConfigError, match=f"never is.*{parent.domain}"):
            SearchSpace([parent, child])


def test_chains_of_conditions() -> None:
    first = Parameter("a", "categorical", choices=("x", "y", "z"))
    second = Parameter("b", "int", 0, 999, when={"a": "x"})
    third = Parameter("c", "int", 0, 1, when={"b": 7})
    space = SearchSpace([first, second, third])
    assert space.size() == len(list(space.all_settings())) == 2 + 1001
    contradiction = Parameter("c", "int", 0, 1, when={"b": 7, "a": "y"})
    with pytest.raises(ConfigError, match="'c' can never exist: it needs 'a' to be y, and 'b'"):
        SearchSpace([first, second, contradiction])


def test_conditions_on_what_is_not_searched() -> None:
    child = Parameter("b", "int", 0, 1, when={"algorithm.ent_coef": "auto"})
    assert SearchSpace([child], {"algorithm.ent_coef": "auto"}).size() == 2
    with pytest.raises(ConfigError, match=r"always auto_0.1\. Did you mean 'auto_0.1'\?"):
        SearchSpace([child], {"algorithm.ent_coef": "auto_0.1"})
    with pytest.raises(
        ConfigError, match=r"must come before it\. Did you mean 'algorithm.ent_coef"
    ):
        SearchSpace([replace(child, when={"algorithm.ent_coeff": 1})], {"algorithm.ent_coef": 1})


def test_ranges_are_counted_and_never_listed() -> None:
    entry = {"type": "int", "low": 1000, "high": 1_000_000_000}
    space = SearchSpace(parse_space({"a": entry, "b": entry}))
    assert space.size() == 999_999_001**2
    first = list(itertools.islice(space.all_settings(), 2))
    assert first == [{"a": 1000, "b": 1000}, {"a": 1000, "b": 1001}]
    assert space.setting_in({"a": 70_000, "b": 1e9}) == {"a": 70_000, "b": 1_000_000_000}
    assert space.setting_in({"a": 70_000, "b": 999}) is None


def test_a_step_that_does_not_divide_the_range_ends_at_its_last_value(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    entries = {
        "a": {"type": "float", "low": 0, "high": 1, "step": 0.3},
        "b": {"type": "int", "low": -10, "high": -1, "step": 4},
    }
    space = SearchSpace(parse_space(entries))
    assert [p.high for p in space.parameters] == [0.9, -2]
    assert "'a' ends at 0.9" in caplog.text and "'b' ends at -2" in caplog.text
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    drawn = [space.suggest(study.ask()) for _ in range(40)]  # Optuna would warn: an error here
    assert {space.identity(setting) for setting in drawn} == {
        space.identity(setting) for setting in space.all_settings()
    }


def test_the_same_step_is_the_same_setting_however_it_was_computed() -> None:
    space = SearchSpace([Parameter("a", "float", 0.0, 1.0, 0.1)])
    assert space.identity({"a": 0.1 + 0.2}) == space.identity({"a": 0.3})
    assert space.identity({"a": 0.31}) is space.identity({"b": 1}) is None


def test_a_grid_without_end_is_refused() -> None:
    parse = OverridesParser.create().parse_overrides
    with pytest.raises(ConfigError, match="This grid has 1,999,999,998 runs"):
        refuse_endless_grid(parse(["seed=range(1,1000000000)", "a=1,2", "b=3"]))
    refuse_endless_grid(parse(["seed=range(1,100)", "a=1,1.0"]))


def test_what_tables_show() -> None:
    shown = [shown_text(value) for value in (None, True, "null", 1.0, 3, "[64,64]")]
    assert shown == ["null", "true", "null", "1", "3", "[64,64]"]
