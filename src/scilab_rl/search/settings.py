"""The keys of ``hydra.sweeper``: the settings of a study, checked before it starts."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.search.pruning import PRUNERS
from scilab_rl.search.race import RaceRules
from scilab_rl.search.samplers import SAMPLERS
from scilab_rl.search.scores import find_score, natural_direction

DIRECTIONS = ("maximize", "minimize")


@dataclass(frozen=True)
class StudySettings:
    """What ``hydra.sweeper`` says about a study; the shipped file explains each key.

    Attributes:
        study_name: Name of the study and of its folder.
        max_trials: Training runs altogether, as in the reference; repeats count, the final
            re-evaluation of the winner does not.
        n_jobs: Runs at the same time; None means one per core.
        direction: One word per objective; empty means the natural one of each score.
        max_duration_minutes: After this time no run is started; None means no limit.
        min_trials_per_param: Runs of each configuration, unless it is pruned or fails.
        max_trials_per_param: Most runs of one configuration.
        n_final_runs: Runs of the winner on seeds that the search never saw.
        search_space: Override key to its description.
        storage: Database URL; None means SQLite in the study's folder.
        sampler: Name of the sampler.
        seed: Seed of the study; 0 draws one.
        score: Name of the score, or one per objective.
        pruner: What stops weak runs.
        pruner_warmup_epochs: Evaluations of each run before it may be pruned; None means a third.
        trial_timeout: Seconds after which a run is killed and has failed; None means never.
        max_retries: How often a run is repeated that the machine has ended.
        fail_fast: The study ends when its first so many runs all fail with the same message; 0
            never does.
        allow_space_change: Whether an existing study may continue with another search space.
    """

    study_name: str = "study"
    max_trials: int = 20
    n_jobs: int | None = None
    direction: tuple[str, ...] = ()
    max_duration_minutes: float | None = None
    min_trials_per_param: int = 3
    max_trials_per_param: int = 12
    n_final_runs: int = 3
    search_space: Mapping[str, object] = field(default_factory=dict)
    storage: str | None = None
    sampler: str = "tpe"
    seed: int = 0
    score: tuple[str, ...] = ("default",)
    pruner: str = "median"
    pruner_warmup_epochs: int | None = None
    trial_timeout: float | None = None
    max_retries: int = 2
    fail_fast: int = 5
    allow_space_change: bool = False

    @property
    def directions(self) -> tuple[str, ...]:
        """The direction of each objective."""
        return self.direction or tuple(map(natural_direction, self.score))

    @property
    def rules(self) -> RaceRules:
        """The budget of the race."""
        return RaceRules(
            budget=self.max_trials,
            min_runs=self.min_trials_per_param,
            max_runs=self.max_trials_per_param,
            maximize=self.directions[0] == "maximize",
            racing=len(self.score) == 1,
        )


def read_settings(given: Mapping[str, object]) -> StudySettings:
    """Check the sweeper's keys; a null means the default.

    Args:
        given: The mapping ``hydra.sweeper`` without its ``_target_``.

    Raises:
        ConfigError: If a key is unknown or a value is invalid.
    """
    names = [f.name for f in dataclasses.fields(StudySettings)]
    for key in given:
        if key not in names:
            raise ConfigError(
                f"There is no key hydra.sweeper.{key}.{did_you_mean(str(key), names)} "
                f"There are {', '.join(names)}."
            )
    values: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    for key in ("direction", "score"):
        if key in values:
            values[key] = _words(values[key])
    for key in ("min_trials_per_param", "max_trials_per_param"):
        _check_count(key, values.get(key, 1), low=1)
    values.setdefault("max_trials_per_param", max(12, values.get("min_trials_per_param", 3)))
    values.setdefault(
        "min_trials_per_param",
        min(3, values["max_trials_per_param"], _count(values.get("max_trials", 3))),
    )
    values.setdefault("n_final_runs", values["min_trials_per_param"])
    settings = StudySettings(**values)
    _check(settings)
    return settings


def _words(value: object) -> tuple[str, ...]:
    given = [value] if isinstance(value, str) or not isinstance(value, Sequence) else value
    return tuple(map(str, given))


def _count(value: object) -> int:
    return value if isinstance(value, int) and value >= 1 else 1


def _check(settings: StudySettings) -> None:
    _check_name(settings.study_name)
    for key, low in (
        ("max_trials", 1), ("n_jobs", 1), ("n_final_runs", 0), ("seed", 0), ("max_retries", 0),
        ("pruner_warmup_epochs", 0), ("fail_fast", 0),
    ):  # fmt: skip
        _check_count(key, getattr(settings, key), low)
    for key in ("max_duration_minutes", "trial_timeout"):
        _check_positive(key, getattr(settings, key))
    if settings.min_trials_per_param > settings.max_trials_per_param:
        raise ConfigError(
            f"min_trials_per_param ({settings.min_trials_per_param}) must not be above "
            f"max_trials_per_param ({settings.max_trials_per_param})."
        )
    for key, word, allowed in (
        ("sampler", settings.sampler, SAMPLERS),
        ("pruner", settings.pruner, PRUNERS),
        *(("direction", word, DIRECTIONS) for word in settings.directions),
    ):
        if word not in allowed:
            raise ConfigError(
                f"hydra.sweeper.{key} must be one of {', '.join(allowed)}, but it is {word!r}."
                f"{did_you_mean(str(word), allowed)}"
            )
    _check_objectives(settings)


def _check_objectives(settings: StudySettings) -> None:
    if len(settings.directions) != len(settings.score):
        raise ConfigError(
            f"There are {len(settings.score)} scores and {len(settings.directions)} directions; "
            "give one direction for each score."
        )
    for name, direction in zip(settings.score, settings.directions, strict=True):
        find_score(name)
        if name == "steps_to_threshold" and direction == "maximize":
            raise ConfigError(
                "score=steps_to_threshold counts steps, of which less is better: set "
                "hydra.sweeper.direction=minimize or leave it out."
            )


def _check_name(name: object) -> None:
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}", name):
        raise ConfigError(
            f"study_name becomes a folder: up to 80 letters, digits and ._- are allowed, "
            f"but it is {name!r}."
        )
    if name == "stop":
        raise ConfigError("study_name must not be 'stop', which `scilab-rl study stop` means.")


def _check_count(key: str, value: object, low: int) -> None:
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ConfigError(
            f"hydra.sweeper.{key} must be a whole number from {low}, but it is {value!r}."
        )


def _check_positive(key: str, value: object) -> None:
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
        raise ConfigError(f"hydra.sweeper.{key} must be a number above 0, but it is {value!r}.")
