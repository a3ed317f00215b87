"""The key ``performance_testing_conditions``: what a performance test asks for."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from scilab_rl.config import CONDITIONS as KEY
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.performance.gate import BoundedTest, ReferenceRule, Rule, SequentialTest
from scilab_rl.workspace import config_files

GROUP = "performance"
SEQUENTIAL, BOUNDED, REFERENCE = RULES = ("sequential", "bounded", "reference")
TIERS = ("pr", "nightly", "release")  # minutes, hours, all: each one holds those before it
_SUCCESS = "eval/success"
_SUCCESS_MARGIN, _RELATIVE_MARGIN = 0.1, 0.1


@dataclass(frozen=True)
class Conditions:
    """What the runs of a performance test have to reach.

    The first five keys are those of the reference.

    Attributes:
        eval_value: The value that is required.
        max_steps: Environment steps of a run at most.
        eval_columns: The metric.
        total_runs: For the reference's rule: so many runs.
        succ_runs: For the reference's rule: so many of them have to reach the value in their last
            evaluation.
        rule: ``sequential`` (the default), ``bounded`` (assumes nothing about the runs, needs more
            of them) or ``reference``.
        margin: How far below ``eval_value`` the mean over runs is certainly too little; None means
            0.1 of success, and a tenth of the value of other metrics.
        alpha: Probability of a wrong PASS and of a wrong FAIL.
        min_runs: Runs before the first decision.
        max_runs: The budget; None means the rule's own.
        n_episodes: Evaluation episodes of each finished policy.
        tier: The smallest set of tests that this one belongs to.
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
    seed: int = 1

    @property
    def is_rate(self) -> bool:
        """Whether the metric is a share of episodes, from 0 to 1."""
        return self.eval_columns.startswith(_SUCCESS)

    @property
    def width(self) -> float:
        """The margin, given or by default."""
        if self.margin is not None:
            return self.margin
        return _SUCCESS_MARGIN if self.is_rate else _RELATIVE_MARGIN * abs(self.eval_value)

    @property
    def stop_value(self) -> float:
        """Mean of the last evaluations at which a run need not learn on.

        A policy that stops here is judged in episodes of its own, so that this may be generous.
        """
        if self.rule == REFERENCE:
            return self.eval_value
        return self.eval_value + self.width / 2

    def make_rule(self) -> Rule:
        """Return the rule that decides."""
        if self.rule == REFERENCE:
            return ReferenceRule(self.eval_value, self.succ_runs, self.total_runs)
        budget = {} if self.max_runs is None else {"max_runs": self.max_runs}
        if self.rule == BOUNDED:
            return BoundedTest(self.eval_value, self.width, self.alpha, **budget)
        limits = (0.0, 1.0) if self.is_rate else (-math.inf, math.inf)
        return SequentialTest(
            self.eval_value, self.width, self.alpha, self.min_runs, limits=limits, **budget
        )


def read_conditions(given: Any, name: str) -> Conditions:
    """Check the key of a file.

    Args:
        given: The mapping; a list with one mapping is taken, too.
        name: The test, for messages.

    Raises:
        ConfigError: If a key is unknown or missing, or a value cannot be.
    """
    if isinstance(given, list) and len(given) == 1:
        given = given[0]
    if not isinstance(given, Mapping):
        raise ConfigError(f"{name}: {KEY} must be a mapping, but it is {given!r}.")
    names = [field.name for field in dataclasses.fields(Conditions)]
    for key in map(str, given):
        if key not in names:
            raise ConfigError(
                f"{name}: there is no key {KEY}.{key}.{did_you_mean(key, names)} There are "
                f"{', '.join(names)}."
            )
    for key in ("eval_value", "max_steps"):
        if given.get(key) is None:
            raise ConfigError(f"{name}: {KEY} needs {key}.")
    conditions = Conditions(**{str(key): value for key, value in given.items()})
    _check(conditions, name)
    return conditions


def _check(conditions: Conditions, name: str) -> None:
    for key, (fits, wanted) in _WANTED.items():
        value = getattr(conditions, key)
        if not (value is None and key in ("margin", "max_runs")) and not fits(value):
            raise ConfigError(f"{name}: {KEY}.{key} must be {wanted}, but it is {value!r}.")
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
    if conditions.rule == BOUNDED and not (conditions.is_rate and required < 1):
        raise ConfigError(f"{name}: rule=bounded is for success rates below 1; take sequential.")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(low: int, value: Any) -> bool:
    return _is_number(value) and float(value).is_integer() and value >= low


_COUNT = (functools.partial(_is_count, 1), "a whole number from 1")
_WANTED: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "eval_value": (_is_number, "a number"),
    "max_steps": _COUNT,
    "eval_columns": (lambda value: str(value).startswith("eval/"), "a metric of the evaluation"),
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
    """Return the performance tests, shipped and of the desk, by name: ``FetchReach/sac_her-test``.

    A file below ``performance/`` is a test when it has the key; others are searches or settings.
    """
    found = {}
    for name, path in config_files(GROUP).items():
        try:
            stored = OmegaConf.load(path)
        except (OSError, OmegaConfBaseException):
            continue  # composing it will tell
        if KEY in stored:
            found[name] = path
    return found


def tier_of(path: Path) -> str:
    """Return the tier that a file says it belongs to."""
    stored: Any = OmegaConf.load(path)
    return str(stored[KEY].get("tier", Conditions.tier))


def select(patterns: list[str], tier: str | None) -> list[str]:
    """Return the names of the tests that fit.

    Args:
        patterns: Parts of names; a test has to contain one of them. Empty means all.
        tier: Only tests that belong to it; None means all.

    Raises:
        ConfigError: If none fits.
    """
    known = performance_tests()
    names = [
        name
        for name, path in known.items()
        if (not patterns or any(word.lower() in name.lower() for word in patterns))
        and (tier is None or TIERS.index(tier_of(path)) <= TIERS.index(tier))
    ]
    if not names:
        wanted = " ".join([*patterns, *([f"--tier {tier}"] if tier else [])])
        raise ConfigError(
            f"No performance test fits '{wanted}'.{did_you_mean(wanted, known)} There are: "
            f"{listing(known, limit=60)}."
        )
    return names
