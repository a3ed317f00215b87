"""How good a run was, as one number: pure functions of its learning curve."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scilab_rl.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Curve:
    """The evaluations of one run.

    Attributes:
        steps: Environment steps at each evaluation, ascending.
        values: The criterion there, for example the success rate. Shapes: as ``steps``.
        budget: Environment steps of a whole run. A solved run, which ended because it had reached
            its threshold counts as if it had stayed at its last value until here.
        threshold: The value that ``steps_to_threshold`` waits for.
    """

    steps: Sequence[int]
    values: Sequence[float]
    budget: int
    threshold: float = 0.9


ScoreFunction = Callable[[Curve], float]


def final(curve: Curve) -> float:
    """Return the last value."""
    return curve.values[-1]


def best(curve: Curve) -> float:
    """Return the largest value; optimistic, because it picks the luckiest evaluation."""
    return max(curve.values)


def auc(curve: Curve) -> float:
    """Return the area under the curve divided by the budget: the mean value over training.

    Each evaluation counts for the steps since the one before; the last one also for what is left
    of the budget.

    >>> auc(Curve(steps=[100, 200], values=[0.0, 1.0], budget=400))
    0.75
    """
    area, previous = 0.0, 0
    for step, value in zip(curve.steps, curve.values, strict=True):
        area += (step - previous) * value
        previous = step
    area += max(curve.budget - previous, 0) * curve.values[-1]
    return area / max(curve.budget, previous)


def default(curve: Curve) -> float:
    """Return the mean of `auc` and `final`: learn fast, and end well.

    >>> default(Curve(steps=[100, 200], values=[0.0, 1.0], budget=200))
    0.75
    """
    return (auc(curve) + final(curve)) / 2


def steps_to_threshold(curve: Curve) -> float:
    """Return the steps until the threshold is reached; the budget when it never is. Less is better.

    >>> steps_to_threshold(Curve([100, 200, 300], [0.2, 0.95, 0.5], budget=300))
    200.0
    """
    for step, value in zip(curve.steps, curve.values, strict=True):
        if value >= curve.threshold:
            return float(step)
    return float(curve.budget)


SCORES: dict[str, ScoreFunction] = {
    function.__name__: function for function in (default, final, best, auc, steps_to_threshold)
}


def natural_direction(name: str) -> str:
    """Return the direction in which a score is better; own functions are maximized by default."""
    return "minimize" if name == "steps_to_threshold" else "maximize"


def find_score(name: str) -> ScoreFunction:
    """Return a score by its name, or an own function by ``package.function``.

    Raises:
        ConfigError: If there is none.
    """
    if name in SCORES:
        return SCORES[name]
    module, _, function = name.rpartition(".")
    if not module:
        raise ConfigError(
            f"There is no score '{name}'.{did_you_mean(name, SCORES)} There are "
            f"{', '.join(SCORES)}, or package.function for one of your own."
        )
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"score: '{name}' cannot be imported: {error}.") from error


def score(function: ScoreFunction, curve: Curve) -> float:
    """Apply a score function and insist on a number.

    Raises:
        ValueError: If the run was never evaluated or its score is not a finite number.
    """
    if not curve.values:
        raise ValueError("the run ended before its first evaluation")
    value = function(curve)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"the score is {value!r}, which is not a finite number")
    return float(value)
