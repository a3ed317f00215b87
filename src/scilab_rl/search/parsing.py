"""Reads search spaces: from a sweeper file, and from the sweeps of a command line."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from typing import TYPE_CHECKING

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.search.space import Parameter, n_steps
from scilab_rl.search.values import is_number, override_text, same_value

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override, RangeSweep

KINDS = ("float", "int", "categorical")
_log = logging.getLogger(__name__)
_OF_RANGES, _OF_CHOICES = ("low", "high", "step", "log"), ("choices",)
_ENTRY_KEYS = ("type", *_OF_RANGES, *_OF_CHOICES, "when")
_LARGEST_INT = 2**53  # Optuna computes with floats, which hold no larger whole numbers
_MOST_RUNS = 10_000


def parse_space(entries: Mapping[str, object]) -> list[Parameter]:
    """Read the ``search_space`` of a sweeper file.

    Args:
        entries: Override key, such as ``++algorithm.gamma``, to its description: ``type`` (float,
            int or categorical), ``low``, ``high``, ``step``, ``log``, ``choices``, ``when``.

    Raises:
        ConfigError: If an entry cannot be understood.
    """
    if not isinstance(entries, Mapping):
        raise ConfigError(
            f"search_space must be a mapping of keys to values, but it is {override_text(entries)}."
        )
    return [_parse_entry(str(key), entry) for key, entry in entries.items()]


def parameter_of(override: Override) -> Parameter:
    """Turn a sweep on the command line into a parameter.

    Args:
        override: For example ``algorithm.gamma=interval(0.9,0.99)``, ``a=choice(1,2)``,
            ``a=range(1,9,2)``, ``a=tag(log,interval(1e-5,1e-2))`` or ``a=int(interval(1,8))``.
    """
    from hydra.core.override_parser.types import ChoiceSweep, Glob, IntervalSweep, RangeSweep

    key, sweep = override.get_key_element(), override.value()
    if isinstance(sweep, (ChoiceSweep, Glob)):
        choices = tuple(override.sweep_iterator())
        return _checked(Parameter(key, "categorical", choices=choices))
    assert isinstance(sweep, (IntervalSweep, RangeSweep))
    log = "log" in sweep.tags
    if isinstance(sweep, IntervalSweep):
        kind = "int" if isinstance(sweep.start, int) and isinstance(sweep.end, int) else "float"
        return _checked(Parameter(key, kind, sweep.start, sweep.end, log=log))
    n = _n_in_range(sweep)
    if n < 1:
        raise ConfigError(f"{key}: the range holds no value.")
    first, step = Decimal(str(sweep.start)), Decimal(str(sweep.step))
    low, high = sorted((first, first + (n - 1) * step))
    if all(isinstance(number, int) for number in (sweep.start, sweep.stop, sweep.step)):
        return _checked(Parameter(key, "int", int(low), int(high), abs(sweep.step), log))
    return _checked(Parameter(key, "float", float(low), float(high), abs(sweep.step), log))


def refuse_endless_grid(overrides: Sequence[Override]) -> None:
    """Reject a grid of more runs than anybody can wait for, before they are listed.

    Raises:
        ConfigError: With the number of runs.
    """
    n_runs = math.prod(_n_in_sweep(o) for o in overrides if o.is_sweep_override())
    if n_runs > _MOST_RUNS:
        raise ConfigError(
            f"This grid has {n_runs:,} runs, of which at most {_MOST_RUNS:,} can be listed. Take "
            "fewer values, or search them: add hydra.sweeper.max_trials=20."
        )


def _n_in_sweep(override: Override) -> int:
    from hydra.core.override_parser.types import RangeSweep

    sweep = override.value()
    if isinstance(sweep, RangeSweep):
        return _n_in_range(sweep)
    return sum(1 for _ in override.sweep_iterator())


def _n_in_range(sweep: RangeSweep) -> int:
    """Return how many values a range holds, which excludes its end."""
    assert sweep.start is not None and sweep.stop is not None
    if sweep.step == 0:
        raise ConfigError("A range needs a step that is not 0.")
    distance = Decimal(str(sweep.stop)) - Decimal(str(sweep.start))
    return max(0, math.ceil(distance / Decimal(str(sweep.step))))


def _parse_entry(key: str, entry: object) -> Parameter:
    if not isinstance(entry, Mapping):
        raise ConfigError(f"search_space: '{key}' needs a type and its bounds or choices.")
    for name in entry:
        if name not in _ENTRY_KEYS:
            raise ConfigError(
                f"search_space: '{key}' has an unknown entry '{name}'."
                f"{did_you_mean(str(name), _ENTRY_KEYS)} There are {', '.join(_ENTRY_KEYS)}."
            )
    kind = entry.get("type")
    if kind not in KINDS:
        raise ConfigError(
            f"search_space: the type of '{key}' must be {', '.join(KINDS)}, but it is {kind!r}."
            f"{did_you_mean(str(kind), KINDS)}"
        )
    if problem := _entry_problem(kind, entry):
        raise ConfigError(f"search_space: '{key}' {problem}.")
    return _checked(
        Parameter(
            key,
            kind,
            low=entry.get("low"),
            high=entry.get("high"),
            step=entry.get("step"),
            log=bool(entry.get("log")),
            choices=tuple(entry.get("choices") or ()),
            when={str(name).lstrip("+"): v for name, v in (entry.get("when") or {}).items()},
        )
    )


def _entry_problem(kind: str, entry: Mapping[str, object]) -> str:
    """Return what is wrong with the form of an entry, or nothing."""
    useless = _OF_RANGES if kind == "categorical" else _OF_CHOICES
    for name in useless:
        if entry.get(name) is not None:
            return f"is {kind}, which has no {name}"
    for name, allowed, wanted in (
        ("choices", (list, tuple), "a list"), ("when", Mapping, "a mapping of keys to values"),
        ("log", bool, "true or false"),
    ):  # fmt: skip
        if not isinstance(entry.get(name), (allowed, type(None))):
            return f"needs {wanted} as {name}, but it is {override_text(entry[name])}"
    return ""


def _checked(parameter: Parameter) -> Parameter:
    problem = _choices_problem if parameter.kind == "categorical" else _range_problem
    if found := problem(parameter):
        raise ConfigError(f"search_space: '{parameter.key}' {found}.")
    return _ending_at_a_step(parameter)


def _choices_problem(p: Parameter) -> str:
    for i, choice in enumerate(p.choices):
        if isinstance(choice, float) and math.isnan(choice):
            return "has nan among its choices, which is not a value"
        if twin := [c for c in p.choices[:i] if same_value(c, choice)]:
            texts = f"{override_text(twin[0])} and {override_text(choice)}"
            return f"has the same value twice among its choices: {texts}"
    return "" if p.choices else "is categorical and needs choices"


def _range_problem(p: Parameter) -> str:
    if p.low is None or p.high is None:
        return "needs low and high"
    numbers = [n for n in (p.low, p.high, p.step) if n is not None]
    for number in numbers:
        if not is_number(number):
            return f"needs numbers as bounds and step, but there is {override_text(number)}"
    if not all(map(_is_finite, (*numbers, p.high - p.low))) or p.low > p.high:
        return f"needs finite bounds with low <= high, but they are {p.low} and {p.high}"
    if p.step is not None and p.step <= 0:
        return f"needs a step above 0, but it is {p.step}"
    if p.log and (p.low <= 0 or (p.step or 1) != 1 or (p.kind == "float" and p.step)):
        return "is logarithmic, which needs low > 0 and no step"
    return _whole_problem(numbers) if p.kind == "int" else ""


def _whole_problem(numbers: Sequence[float]) -> str:
    if any(float(n) != int(n) for n in numbers):
        return "is int and needs whole numbers"
    if any(abs(n) > _LARGEST_INT for n in numbers):
        return f"is int and needs numbers up to 2^53 ({_LARGEST_INT})"
    return ""


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:  # a whole number beyond all floats
        return False


def _ending_at_a_step(p: Parameter) -> Parameter:
    """Return the parameter with the highest value that its steps reach, and tell if that differs.

    Optuna would do so too, and warn each time it draws a value.
    """
    if p.step is None or p.low is None or p.high is None:
        return p
    n = n_steps(p.low, p.high, p.step)
    last = p.low + n * p.step
    if p.kind == "float":
        last = float(Decimal(str(p.low)) + n * Decimal(str(p.step)))
    if math.isclose(last, p.high, rel_tol=1e-12):
        return p
    _log.info(
        "search_space: '%s' ends at %s, the last value from %s in steps of %s; %s is not reached.",
        p.key, last, p.low, p.step, p.high,
    )  # fmt: skip
    return replace(p, high=last)
