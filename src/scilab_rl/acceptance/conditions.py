"""The key ``performance_testing_conditions``: the target of a performance test."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from scilab_rl.acceptance.rules import ReferenceRule, Rule, SequentialTest
from scilab_rl.config.compose import read_yaml
from scilab_rl.config.schema import CONDITIONS as KEY
from scilab_rl.config.workspace import config_files
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.metrics.names import EVAL_METRICS

GROUP = "performance"
SEQUENTIAL, REFERENCE = RULES = ("sequential", "reference")
TIERS = ("pr", "nightly", "release")  # minutes, hours, all: each includes those before it
_USED_BY = {
    SEQUENTIAL: ("margin", "alpha", "min_runs", "max_runs", "n_episodes"),
    REFERENCE: ("total_runs", "succ_runs"),
}
_OF_RULES = {key for keys in _USED_BY.values() for key in keys}
_SUCCESS = "eval/success"
_log = logging.getLogger(__name__)
_SUCCESS_MARGIN, _RELATIVE_MARGIN = 0.1, 0.1


@dataclass(frozen=True)
class Conditions:
    """The target of a performance test, and the rule that decides.

    The first five keys are those of the reference. A key that the rule does not use is rejected.

    Attributes:
        eval_value: The target.
        max_steps: The most environment steps of a run.
        eval_columns: The metric.
        total_runs: For the reference's rule: the number of runs.
        succ_runs: For the reference's rule: how many of them have to reach the target in their last
            evaluation.
        rule: ``sequential`` (the default) or ``reference`` (the default of a file with total_runs
            or succ_runs).
        margin: A mean over runs this far below ``eval_value`` is certainly too low; None means
            0.1 of success, and a tenth of the value of other metrics.
        alpha: Probability of a wrong PASS and of a wrong FAIL.
        min_runs: Runs before the first decision.
        max_runs: The budget; None means the rule's own.
        n_episodes: Evaluation episodes of each finished policy.
        tier: The smallest set of tests that this one belongs to.
        hours: About how long three runs of ``max_steps`` take, in hours of one core; stated where
            no baseline says it.
        seed: The seeds of the runs follow from it.
    """

    eval_value: float
    max_steps: int
    eval_columns: str = "eval/success_rate"
    total_runs: int = 3
    succ_runs: int = 2
    rule: str = SEQUENTIAL
    margin: float | None = None
    alpha: float = 0.05
    min_runs: int = 3
    max_runs: int | None = None
    n_episodes: int = 100
    tier: str = "release"
    hours: float | None = None
    seed: int = 1

    @property
    def is_rate(self) -> bool:
        """Whether the metric is a share of episodes, from 0 to 1."""
        return self.eval_columns.startswith(_SUCCESS)

    @property
    def width(self) -> float:
        """The margin, as given or by default."""
        if self.margin is not None:
            return self.margin
        return _SUCCESS_MARGIN if self.is_rate else _RELATIVE_MARGIN * abs(self.eval_value)

    @property
    def stop_value(self) -> float:
        """Mean of the last evaluations at which a run may stop.

        The policy is then evaluated in separate episodes, so that this may be generous.
        """
        if self.rule == REFERENCE:
            return self.eval_value
        return self.eval_value + self.width / 2

    def make_rule(self) -> Rule:
        """Return the rule that decides."""
        if self.rule == REFERENCE:
            return ReferenceRule(self.eval_value, self.succ_runs, self.total_runs)
        budget = {} if self.max_runs is None else {"max_runs": self.max_runs}
        limits = (0.0, 1.0) if self.is_rate else (-math.inf, math.inf)
        return SequentialTest(
            self.eval_value, self.width, self.alpha, self.min_runs, limits=limits, **budget
        )


def read_conditions(given: object, name: str, rule: str | None = None) -> Conditions:
    """Check the key of a file.

    Args:
        given: The mapping, or a list with one mapping.
        name: The test, for messages.
        rule: The rule that the command line chooses; keys for another one are ignored.

    Raises:
        ConfigError: If a key is unknown or missing, or a value is invalid.
    """
    if isinstance(given, list) and len(given) == 1:
        given = given[0]
    if not isinstance(given, Mapping):
        raise ConfigError(f"{name}: {KEY} must be a mapping, but it is {given!r}.")
    names = [field.name for field in dataclasses.fields(Conditions)]
    for key in map(str, given):
        if key not in names:
            raise ConfigError(
                f"{name}: {KEY}.{key} is not a key.{did_you_mean(key, names)} Keys: "
                f"{', '.join(names)}."
            )
    for key in ("eval_value", "max_steps"):
        if given.get(key) is None:
            raise ConfigError(f"{name}: {KEY} requires {key}.")
    conditions = Conditions(**_for_its_rule({str(k): v for k, v in given.items()}, name, rule))
    _check(conditions, name)
    return conditions


def _for_its_rule(given: dict[str, Any], name: str, chosen: str | None) -> dict[str, Any]:
    """Return the mapping with its rule and without the keys of the other one.

    Raises:
        ConfigError: If the rule does not use a key.
    """
    of_reference = any(given.get(key) is not None for key in _USED_BY[REFERENCE])
    rule = chosen or given.get("rule") or (REFERENCE if of_reference else SEQUENTIAL)
    used = _USED_BY.get(rule, _OF_RULES)
    unused = [key for key in given if key in _OF_RULES and key not in used]
    if unused and not chosen:
        raise ConfigError(
            f"{name}: rule={rule} does not use {', '.join(unused)}. total_runs and succ_runs "
            "belong to rule=reference; margin, alpha, min_runs, max_runs and n_episodes to "
            "rule=sequential."
        )
    if of_reference and rule == REFERENCE and not given.get("rule"):
        _log.info("%s: total_runs and succ_runs select rule=reference, as in 2024.", name)
    return {k: v for k, v in given.items() if k not in unused} | {"rule": rule}


def _check(conditions: Conditions, name: str) -> None:
    for key, (fits, allowed) in _ALLOWED.items():
        value = getattr(conditions, key)
        if not (value is None and key in ("margin", "max_runs")) and not fits(value):
            nearest = did_you_mean(str(value), EVAL_METRICS) if key == "eval_columns" else ""
            raise ConfigError(
                f"{name}: {KEY}.{key} must be {allowed}, but it is {value!r}.{nearest}"
            )
    if conditions.succ_runs > conditions.total_runs:
        raise ConfigError(
            f"{name}: succ_runs ({conditions.succ_runs}) must not be above total_runs "
            f"({conditions.total_runs})."
        )
    if conditions.max_runs is not None and conditions.max_runs < conditions.min_runs:
        raise ConfigError(
            f"{name}: max_runs ({conditions.max_runs}) must not be below min_runs "
            f"({conditions.min_runs})."
        )
    required, low = conditions.eval_value, conditions.eval_value - conditions.width
    if conditions.is_rate and not (0 < required <= 1 and low > 0):
        raise ConfigError(
            f"{name}: eval_value ({required:g}) of a success rate must be at most 1, and more than "
            f"the margin ({conditions.width:g})."
        )


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(low: int, value: object) -> bool:
    return _is_number(value) and float(value).is_integer() and value >= low


_COUNT = (functools.partial(_is_count, 1), "a whole number from 1")
_ALLOWED: Mapping[str, tuple[Callable[[object], bool], str]] = {
    "eval_value": (_is_number, "a number"),
    "max_steps": _COUNT,
    "eval_columns": (lambda value: value in EVAL_METRICS, f"one of {', '.join(EVAL_METRICS)}"),
    "total_runs": _COUNT,
    "succ_runs": _COUNT,
    "rule": (lambda value: value in RULES, f"one of {', '.join(RULES)}"),
    "margin": (lambda value: _is_number(value) and value > 0, "a number above 0"),
    "alpha": (lambda value: _is_number(value) and 0 < value < 0.5, "between 0 and 0.5"),
    "min_runs": (functools.partial(_is_count, 2), "a whole number from 2"),
    "max_runs": (functools.partial(_is_count, 2), "a whole number from 2"),
    "n_episodes": _COUNT,
    "tier": (lambda value: value in TIERS, f"one of {', '.join(TIERS)}"),
    "seed": _COUNT,
}


def performance_tests() -> dict[str, Path]:
    """Return all performance tests, shipped and own, by name: ``FetchReach/sac_her-test``.

    A file below ``performance/`` is a test if it has the key; others are searches or settings.
    """
    found = {}
    for name, path in config_files(GROUP).items():
        with contextlib.suppress(ConfigError):  # composing it reports the error
            if KEY in read_yaml(path):
                found[name] = path
    return found


def tier_of(path: Path) -> str:
    """Return the tier of a test's file."""
    return str(stated(path, "tier"))


def stated(path: Path, key: str) -> object:
    """Return a condition of a test's file, or its default."""
    return read_yaml(path)[KEY].get(key, getattr(Conditions, key))


def select(patterns: list[str], tier: str | None) -> list[str]:
    """Return the names of the selected tests.

    Args:
        patterns: Parts of names, of which one has to match. Empty means all.
        tier: Only tests that belong to it; None means all.

    Raises:
        ConfigError: If there is none.
    """
    known = performance_tests()
    names = [
        name
        for name, path in known.items()
        if (not patterns or any(word.lower() in name.lower() for word in patterns))
        and (tier is None or TIERS.index(tier_of(path)) <= TIERS.index(tier))
    ]
    if not names:
        given = " ".join([*patterns, *([f"--tier {tier}"] if tier else [])])
        raise ConfigError(
            f"No performance test matches '{given}'.{did_you_mean(given, known)} Tests: "
            f"{listing(known, limit=60)}."
        )
    return names
