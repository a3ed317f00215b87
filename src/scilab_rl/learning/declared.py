"""The metrics that an algorithm's class declares: misspelled names are rejected at the start.

A class lists the metrics that it records, besides those of the classes that it is made from::

    metrics = (
        "train/critic_loss",
        "train/rollout_obs_step_*",  # a pattern, for names with numbers
        ("train/ent_coef_loss", "ent_coef is auto", lambda self: self.learns_ent_coef),
    )

An entry with a reason is recorded only under that condition; without a function, the condition is
known only while the algorithm learns. The contract test compares this with what is recorded.
"""

from __future__ import annotations

import fnmatch
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from scilab_rl.learning.inspector import INTRINSIC_REWARD, quantities_asked_directly
from scilab_rl.metrics.names import FRAMEWORK_METRICS, INTRINSIC_METRICS

MetricEntry = str | tuple[str, str] | tuple[str, str, Callable[[Any], bool]]
_LIBRARIES = ("stable_baselines3", "sb3_contrib")


class Metric(NamedTuple):
    """A declared metric.

    Attributes:
        name: ``section/name``, or a pattern with a star.
        condition: When it is recorded; empty: always.
        holds: Returns whether the condition holds for an algorithm; None: only learning tells.
    """

    name: str
    condition: str = ""
    holds: Callable[[Any], bool] | None = None

    def is_certain(self, algorithm: object) -> bool:
        """Return whether the algorithm records it in any case."""
        return not self.condition or (self.holds is not None and self.holds(algorithm))

    def is_absent(self, algorithm: object) -> bool:
        """Return whether the algorithm cannot record it in its configuration."""
        return self.holds is not None and not self.holds(algorithm)


@dataclass(frozen=True)
class RecordedMetrics:
    """A metric that an algorithm declares.

    Attributes:
        names: Names and patterns.
        absent: Declared names that it does not record here, and when it would.
    """

    names: frozenset[str]
    absent: Mapping[str, str] = field(default_factory=dict)


def _ent_coef_is_learned(algorithm: Any) -> bool:
    return algorithm.ent_coef_optimizer is not None


def _policy_has_std(algorithm: Any) -> bool:
    return hasattr(algorithm.policy, "log_std")


_UPDATES = ("train/n_updates", "train/learning_rate")
_ACTOR_CRITIC = (*_UPDATES, "train/actor_loss", "train/critic_loss")
_ENTROPY = (
    "train/ent_coef",
    ("train/ent_coef_loss", "ent_coef is auto", _ent_coef_is_learned),
)
_VALUES = (*_UPDATES, "train/loss", "rollout/exploration_rate")
_ON_POLICY = (
    *_UPDATES,
    "train/value_loss",
    "train/explained_variance",
    ("train/std", "actions are continuous", _policy_has_std),
)
_CLIPPED = (
    *_ON_POLICY,
    "train/entropy_loss",
    "train/policy_gradient_loss",
    "train/approx_kl",
    "train/clip_fraction",
    "train/loss",
    "train/clip_range",
    ("train/clip_range_vf", "clip_range_vf is given", lambda a: a.clip_range_vf is not None),
)
# Stable-Baselines3 says this only in its `train` methods.
_OF_LIBRARIES: dict[str, tuple[MetricEntry, ...]] = {
    "SAC": (*_ACTOR_CRITIC, *_ENTROPY),
    "TQC": (*_ACTOR_CRITIC, *_ENTROPY),
    "CrossQ": (*_ACTOR_CRITIC, *_ENTROPY),
    "TD3": _ACTOR_CRITIC,
    "DQN": _VALUES,
    "QRDQN": _VALUES,
    "PPO": _CLIPPED,
    "RecurrentPPO": _CLIPPED,
    "MaskablePPO": _CLIPPED,
    "A2C": (*_ON_POLICY, "train/entropy_loss", "train/policy_loss"),
    "TRPO": (
        *_ON_POLICY,
        "train/policy_objective",
        "train/kl_divergence_loss",
        "train/is_line_search_success",
    ),
}


def declared_metrics(cls: type) -> list[Metric]:
    """Return what a class and those that it is made from declare."""
    entries: list[MetricEntry] = []
    for ancestor in cls.__mro__:
        entries += vars(ancestor).get("metrics", ())
        if ancestor.__module__.startswith(_LIBRARIES):
            entries += _OF_LIBRARIES.get(ancestor.__name__, ())
    metrics = [Metric(entry) if isinstance(entry, str) else Metric(*entry) for entry in entries]
    return list({metric.name: metric for metric in reversed(metrics)}.values())[::-1]


def recorded_metrics(algorithm: object) -> RecordedMetrics:
    """Return what an algorithm records, with its intrinsic reward and what the framework adds."""
    names, absent = set(FRAMEWORK_METRICS), {}
    for part in (algorithm, getattr(algorithm, "intrinsic", None)):
        for metric in declared_metrics(type(part)):
            if metric.is_absent(part):
                absent[metric.name] = metric.condition
            else:
                names.add(metric.name)
    if INTRINSIC_REWARD in quantities_asked_directly(algorithm):
        names |= {*INTRINSIC_METRICS}
    else:
        absent |= dict.fromkeys(INTRINSIC_METRICS, "it gives itself a reward (algorithm.intrinsic)")
    return RecordedMetrics(frozenset(names), absent)


def possible_metrics(*classes: type) -> RecordedMetrics:
    """Return what algorithms of some classes may record, whatever their configuration is."""
    names = {metric.name for cls in classes for metric in declared_metrics(cls)}
    return RecordedMetrics(frozenset({*names, *FRAMEWORK_METRICS, *INTRINSIC_METRICS}))


def how_to_declare(cls: type, name: str) -> str:
    """Return what to do if the user's own class does record a metric that it does not declare."""
    if cls.__module__.startswith(("scilab_rl.", *_LIBRARIES)):
        return ""
    own = vars(cls).get("metrics", ())
    line = f'metrics = ("{name}",)' if not own else f'"{name}" to metrics'
    return f" If {cls.__name__} records it, add {line} in {_file_of(cls)}."


def differences(algorithm: object, recorded: Iterable[str]) -> list[str]:
    """Compare what an algorithm's class declares with the names that it has recorded.

    Returns:
        A line for each metric that is undeclared, or declared and not recorded.
    """
    declared = declared_metrics(type(algorithm))
    fits = fnmatch.fnmatchcase
    lines = []
    for name in sorted(recorded):
        metric = next((metric for metric in declared if fits(name, metric.name)), None)
        if metric is None:
            hint = how_to_declare(type(algorithm), name) or " Add it to `metrics` of its class."
            lines.append(f"{name} is recorded and not declared.{hint}")
        elif metric.is_absent(algorithm):
            lines.append(f"{name} is recorded, though it is declared only when {metric.condition}.")
    for metric in declared:
        if metric.is_certain(algorithm) and not any(fits(n, metric.name) for n in recorded):
            lines.append(
                f"{metric.name} is declared in `metrics` and was not recorded. Take it out, or say "
                f'when it is: ("{metric.name}", "the condition").'
            )
    return lines


def _file_of(cls: type) -> str:
    try:
        return f"{cls.__module__.replace('.', '/')}.py" if inspect.getfile(cls) else ""
    except (OSError, TypeError):
        return cls.__module__
