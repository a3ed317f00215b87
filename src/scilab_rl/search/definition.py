"""What a study was made with, as its database keeps it."""

from __future__ import annotations

from typing import TypedDict


class ParameterDescription(TypedDict, total=False):
    """One dimension of the search space; see `space.Parameter`.

    ``choices`` are the labels that Optuna stores, ``values`` the choices where these differ.
    """

    key: str
    kind: str
    low: float
    high: float
    step: float
    log: bool
    choices: list[object]
    values: list[object]
    when: dict[str, object]


class StudyDefinition(TypedDict):
    """What must stay the same when a study is continued, and what its report tells."""

    seed: int
    overrides: list[str]
    space: dict[str, ParameterDescription]
    score: list[str]
    directions: list[str]
    min_runs: int
    max_runs: int
    env: str
    algorithm: str
    criterion: str
    configuration: dict[str, str]
