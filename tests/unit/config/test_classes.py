from __future__ import annotations

from fractions import Fraction
from functools import partial

import pytest

from scilab_rl.config.classes import build
from scilab_rl.errors import ConfigError

HALF = {"_target_": "fractions.Fraction", "numerator": 1, "denominator": 2}


def test_objects_are_built_with_those_inside_of_them() -> None:
    nested = {"_target_": "builtins.dict", "a": HALF, "b": [HALF, 3], "c": {"d": HALF}}
    half = Fraction(1, 2)
    assert build(nested, "key") == {"a": half, "b": [half, 3], "c": {"d": half}}
    assert build({"_target_": "fractions.Fraction", "_args_": [3, 4]}, "key") == Fraction(3, 4)
    assert build("text", "key") == "text"
    assert HALF == {"_target_": "fractions.Fraction", "numerator": 1, "denominator": 2}


@pytest.mark.parametrize("entry", [HALF, {**HALF, "_partial_": True}])
def test_arguments_are_bound_without_the_call(entry: dict) -> None:
    made = build(entry, "wrappers", is_partial="_partial_" not in entry)
    assert isinstance(made, partial)
    assert made.func is Fraction
    assert made(denominator=4) == Fraction(1, 4)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"_target_": "fractions.Fracton"}, r"key\._target_: there is no 'Fracton'.*'Fraction'"),
        ({"_target_": "fractions.Fraction", "x": 1}, r"key: TypeError: .*'x'"),
        ({"_target_": "fractions.Fraction", "denominator": 0}, "key: ZeroDivisionError"),
        ({"a": [{"_target_": "no_such_module.A"}]}, r"key\.a\._target_: .*cannot be imported"),
    ],
)
def test_what_cannot_be_built_is_named(value: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(value, "key")


def test_a_wrapper_needs_a_class() -> None:
    with pytest.raises(ConfigError, match="Each entry of wrappers needs a _target_"):
        build({"name": "x"}, "wrappers", is_partial=True)
