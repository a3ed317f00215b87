"""Behavior of people, models and trained agents in the same choice task."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.analysis.fitting.behavior import BehaviorGroup, behavior_group
from scilab_rl.analysis.fitting.estimation import find_model, fit
from scilab_rl.analysis.fitting.panel import Panel, make_panel, read_panel
from scilab_rl.analysis.fitting.predictive import simulated_panel, size_of
from scilab_rl.analysis.fitting.simulation import make_task
from scilab_rl.analysis.fitting.words import MODEL, TABLES, split_label
from scilab_rl.analysis.groups import RunRecord, find_group, read_records
from scilab_rl.api.agent import find
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import config_files, open_project
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import CONFIG_FILE

N_SIMULATED = 20  # participants with the parameters of a model's YAML


@dataclass(frozen=True)
class BehaviorSettings:
    """How behavior is compared.

    Attributes:
        env: The task; empty: the one that tables and runs name.
        env_kwargs: Arguments of the task for models, besides those of the runs.
        n_episodes: Episodes of each agent.
        softmax: Agents choose with probability proportional to exp(softmax Q); None: models by
            their probabilities, other agents the likeliest action.
        seed: Of fits and simulations; agents get the seed of their run plus 1.
    """

    env: str = ""
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    n_episodes: int = 20
    softmax: float | None = None
    seed: int = 0


@dataclass(frozen=True)
class _Choices:
    label: str
    meaning: str
    panel: Panel
    env_kwargs: Mapping[str, Any] | None = None  # known for agents

    @property
    def is_table(self) -> bool:
        return self.env_kwargs is None


def compare_behavior(
    words: Sequence[str], settings: BehaviorSettings, base: Path = Path("data")
) -> tuple[str, list[BehaviorGroup]]:
    """Return the task, and what each group does in it.

    Models act with the parameters that fit each participant of the first table; without a table,
    with those of their YAML.

    Args:
        words: Each a table of choices, ``model:NAME``, or a word for runs, such as ``agent:NAME``;
            ``LABEL=WORD`` names the group.
        settings: How.
        base: The folder of all runs.

    Raises:
        ConfigError: If tasks differ, or a table, model or run does not fit.
    """
    if len(words) < 2:
        raise ConfigError("compare requires two groups: compare human.csv model:rescorlawagner")
    named = [split_label(word) for word in words]
    if len({label for label, _ in named}) < len(named):
        raise ConfigError("Two groups have the same name: give one as LABEL=GROUP.")
    open_project()
    found = {
        label: _read_table(label, word)
        if word.endswith(TABLES)
        else _ask_agents(label, word, settings, base)
        for label, word in named
        if not word.startswith(MODEL)
    }
    task = _only_task(list(found.values()), settings.env)
    for label, word in named:
        if word.startswith(MODEL):
            found[label] = _ask_model(label, word, list(found.values()), task, settings)
    groups = [found[label] for label, _ in named]
    return task, [behavior_group(c.label, c.meaning, c.panel) for c in groups]


def _read_table(label: str, word: str) -> _Choices:
    panel = read_panel(Path(word))
    if len(tasks := {str(row.get("env", "")) for rows in panel.rows for row in rows}) > 1:
        raise ConfigError(f"'{word}' has choices of several tasks: {', '.join(sorted(tasks))}.")
    return _Choices(label, "table of choices", panel)


def _ask_agents(label: str, word: str, settings: BehaviorSettings, base: Path) -> _Choices:
    """Let each run of a group act."""
    group = find_group(word, lambda: read_records(base), base)
    for record in group.runs:
        make_task(record.env, {})  # before it acts, refuse what is no choice task
    rows = [row for record in group.runs for row in _act(record, settings)]
    kwargs = [dict(load_recorded(run.path / CONFIG_FILE).env_kwargs) for run in group.runs]
    _require_one({f"{label}, run {k}": json.dumps(own) for k, own in enumerate(kwargs, 1)})
    names = " and ".join(dict.fromkeys(run.algorithm for run in group.runs))
    n = len(group.runs)
    about = f"{names}, {n} trained run{'s' * (n > 1)}"
    return _Choices(label, about, make_panel(rows, word), kwargs[0])


def _act(record: RunRecord, settings: BehaviorSettings) -> Iterable[dict[str, Any]]:
    with find(record.path, "finished") as agent:
        rows = agent.trajectories(settings.n_episodes, softmax=settings.softmax)
    return [{"participant_id": record.path.name, "env": record.env, **row} for row in rows]


def _only_task(found: Sequence[_Choices], env: str) -> str:
    """Return the id of the task of all; empty if it is nowhere named."""
    tasks = {c.label: c.panel.env for c in found if c.panel.env} | ({"--env": env} if env else {})
    task = _require_one({label: resolve_env_id(task)[0] for label, task in tasks.items()})
    _require_one({c.label: f"{c.panel.n_stages} choice(s) per trial" for c in found})
    _require_one({c.label: json.dumps(c.env_kwargs) for c in found if not c.is_table})
    return task


def _require_one(of_groups: Mapping[str, str]) -> str:
    """Return what all groups have in common.

    Raises:
        ConfigError: If they differ.
    """
    if len(set(of_groups.values())) > 1:
        listed = ", ".join(f"{label} {what}" for label, what in of_groups.items())
        raise ConfigError(f"Behavior is compared in one task, but these differ: {listed}.")
    return next(iter(of_groups.values()), "")


def _ask_model(
    label: str, word: str, found: Sequence[_Choices], task: str, settings: BehaviorSettings
) -> _Choices:
    """Let a model act, as it fits the people or as its YAML says."""
    if not task:
        raise ConfigError(f"No table names its task, in which {word} could act; add --env TASK.")
    name = word.removeprefix(MODEL)
    model, people = find_model(name), next((c for c in found if c.is_table), None)
    if people is not None:
        values, about = fit(name, people.panel, seed=settings.seed).values, f"fit to {people.label}"
    else:
        values, about = _default_values(name, model.parameters), "parameters of its YAML"
    size = size_of(found[0].panel) if found else (None, settings.n_episodes)
    env_kwargs = {k: v for c in found for k, v in (c.env_kwargs or {}).items()}
    panel = simulated_panel(
        model, values, size, task, env_kwargs | dict(settings.env_kwargs), settings.seed
    )
    return _Choices(label, f"model {name}, {about}", panel, env_kwargs)


def _default_values(name: str, parameters: Iterable[str]) -> dict[str, np.ndarray]:
    import yaml

    options = yaml.safe_load(config_files("algorithm")[name].read_text(encoding="utf-8"))
    return {name: np.full(N_SIMULATED, options[name]) for name in parameters}
