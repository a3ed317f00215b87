"""The results of a study: one row per configuration, the winner, the held-out runs."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import optuna
from optuna.trial import FrozenTrial, TrialState

from scilab_rl.errors import ConfigError
from scilab_rl.search import race
from scilab_rl.search.definition import StudyDefinition
from scilab_rl.search.runs import COMPLETE, FAILED, PRUNED, RUNNING, Run, RunHistory
from scilab_rl.search.space import Setting
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.values import is_number, shown_text

_FEWEST_FOR_IMPORTANCE = 8
WINNER, CONTENDER, BEATEN = "winner", "may still be best", "beaten"


@dataclass(frozen=True)
class ConfigurationRow:
    """The results of one configuration.

    Attributes:
        number: Trial number.
        configuration: Its values.
        n_runs: Complete runs.
        mean: Mean score, or None without a complete run.
        half_width: Of the confidence interval of the mean.
        verdict: ``winner``, ``may still be best``, ``beaten``, ``pruned``, ``failed`` or
            ``incomplete``.
        values: Mean of each objective.
    """

    number: int
    configuration: Setting
    n_runs: int
    mean: float | None
    half_width: float
    verdict: str
    values: tuple[float, ...] = ()

    @property
    def interval(self) -> str:
        """The mean and its interval as text."""
        return "-" if self.mean is None else with_interval(self.mean, self.half_width)


@dataclass(frozen=True)
class Summary:
    """Everything that the report tells.

    Attributes:
        name: The study.
        definition: What it was made with.
        runs: All runs.
        rows: All configurations, the best first.
        front: Configurations that no other beats in all objectives, with several objectives.
        final_scores: Of the winner with held-out seeds.
        final_half_width: Of the interval of their mean.
        importance: How much of the differences each parameter explains, 0 to 1.
    """

    name: str
    definition: StudyDefinition
    runs: Sequence[Run]
    rows: Sequence[ConfigurationRow]
    front: Sequence[int]
    final_scores: tuple[float, ...]
    final_half_width: float
    importance: Mapping[str, float]

    @property
    def winner(self) -> ConfigurationRow | None:
        """The best configuration; None with several objectives or no complete run."""
        return next((row for row in self.rows if row.verdict == WINNER), None)

    @property
    def counts(self) -> dict[str, int]:
        """Runs per state, without the re-evaluation of the winner."""
        return dict(Counter(run.state for run in self.runs if not run.is_final))

    @property
    def final_mean(self) -> float | None:
        """Mean score of the winner with held-out seeds."""
        n = len(self.final_scores)
        return math.fsum(self.final_scores) / n if n else None

    @property
    def maximize(self) -> bool:
        """Whether a larger first score is better."""
        return bool(self.definition["directions"][0] == "maximize")

    def facts(self) -> list[tuple[str, str]]:
        """Return what to tell first, name and value."""
        counts = ", ".join(f"{count} {state}" for state, count in self.counts.items())
        facts = [
            ("study", self.name),
            ("task", f"{self.definition['algorithm']} on {self.definition['env']}"),
            ("runs", f"{sum(self.counts.values())} ({counts or 'none'})"),
            ("configurations", str(len(self.rows))),
        ]
        if self.front:
            return [*facts, ("best trade-offs", ", ".join(f"#{n}" for n in self.front))]
        if self.winner is None:
            return [*facts, ("best configuration", "none: no run is complete")]
        rivals = sum(row.verdict == CONTENDER for row in self.rows)
        final = "not yet; the same command does it"
        if self.final_mean is not None:
            final = with_interval(self.final_mean, self.final_half_width)
            final += f" ({len(self.final_scores)} runs)"
        return [
            *facts,
            ("best configuration", f"#{self.winner.number}: {as_text(self.winner.configuration)}"),
            ("score in the search", f"{self.winner.interval} ({self.winner.n_runs} runs)"),
            ("score with new seeds", final),
            ("other configurations that may be best", str(rivals)),
        ]

    def table(self) -> str:
        """Return all configurations as CSV."""
        names = list(self.definition["space"])
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["configuration", *names, "runs", "mean", "half_width", "verdict"])
        for row in self.rows:
            # A cell is empty where the parameter does not exist, and says null where it is null.
            stored = (row.configuration.get(name, "") for name in names)
            values = [v if is_number(v) else shown_text(v) for v in stored]
            mean = "" if row.mean is None else row.mean
            width = row.half_width if math.isfinite(row.half_width) else ""
            writer.writerow([row.number, *values, row.n_runs, mean, width, row.verdict])
        return text.getvalue()


def summarize(storage: StudyStorage) -> Summary:
    """Compute what a study has found so far."""
    definition, runs, trials, configurations = storage.transact(
        lambda: (
            storage.definition(),
            storage.runs(),
            storage.trials(),
            storage.configurations(),
        )
    )
    if definition is None:
        raise ConfigError(f"The study {storage.directory.name} was ended before it began.")
    rules = race.RaceRules(
        budget=0,
        min_runs=definition["min_runs"],
        max_runs=definition["max_runs"],
        maximize=definition["directions"][0] == "maximize",
    )
    with_runs = {run.trial for run in runs}
    configurations = {n: s for n, s in configurations.items() if n in with_runs}
    history = RunHistory(runs)
    entries = history.entries(configurations)
    several = len(definition["directions"]) > 1
    winner = None if several else race.winner(entries, rules)
    final = tuple(
        run.scores[0]
        for run in runs
        if run.is_final and run.state == COMPLETE and winner and run.trial == winner.number
    )
    rows = _rows(entries, configurations, history, rules, winner)
    return Summary(
        name=storage.directory.name,
        definition=definition,
        runs=runs,
        rows=sorted(rows, key=lambda row: _rank(row, rules)),
        front=[t.number for t in storage.study.best_trials] if several else [],
        final_scores=final,
        final_half_width=_final_half_width(final, entries, rules),
        importance={} if several else importance_of(rows, trials, maximize=rules.maximize),
    )


def importance_of(
    rows: Sequence[ConfigurationRow], trials: Sequence[FrozenTrial], *, maximize: bool
) -> dict[str, float]:
    """Return how much each parameter matters, by PED-ANOVA (Watanabe et al., 2023).

    With all repeats of each configuration, which the sampler has only partly seen.
    """
    means = {row.number: row.mean for row in rows if row.mean is not None}
    study = optuna.create_study(direction="maximize" if maximize else "minimize")
    for trial in trials:
        if trial.number in means and trial.state == TrialState.COMPLETE:
            study.add_trial(
                optuna.trial.create_trial(
                    params=trial.params,
                    distributions=trial.distributions,
                    value=means[trial.number],
                )
            )
    if len(study.trials) < _FEWEST_FOR_IMPORTANCE:
        return {}
    try:
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return optuna.importance.get_param_importances(study, evaluator=evaluator)
    except (ValueError, RuntimeError):  # no two configurations differ
        return {}


def as_text(configuration: Setting) -> str:
    """Return a configuration as one line.

    >>> as_text({"algorithm.gamma": 0.98765432})
    'algorithm.gamma=0.987654'
    """
    return ", ".join(f"{name}={shown_text(value)}" for name, value in configuration.items())


def with_interval(mean: float, half_width: float) -> str:
    """Return a mean and its interval as text.

    >>> with_interval(0.5, 0.125)
    '0.5 ± 0.12'
    """
    return f"{mean:.4g}" + (f" ± {half_width:.2g}" if math.isfinite(half_width) else " ± ?")


def _rows(
    entries: Sequence[race.Entry],
    configurations: Mapping[int, Setting],
    history: RunHistory,
    rules: race.RaceRules,
    winner: race.Entry | None,
) -> list[ConfigurationRow]:
    spread = race.spread_of([entry for entry in entries if entry.scores], rules)
    contenders = {entry.number for entry in race.may_still_be_best(entries, rules)}
    rows = []
    for entry in entries:
        runs = history.by_trial.get(entry.number, {}).values()
        scored = [run.scores for run in runs if run.state == COMPLETE]
        rows.append(
            ConfigurationRow(
                entry.number,
                configurations[entry.number],
                len(entry.scores),
                entry.mean if entry.scores else None,
                race.half_width(entry, spread) if entry.scores else math.inf,
                _verdict(entry, runs, rules, contenders, winner),
                tuple(math.fsum(v) / len(v) for v in zip(*scored, strict=True)),
            )
        )
    return rows


def _verdict(
    entry: race.Entry,
    runs: Iterable[Run],
    rules: race.RaceRules,
    contenders: set[int],
    winner: race.Entry | None,
) -> str:
    if winner is not None and entry.number == winner.number:
        return WINNER
    if entry.eliminated:
        return FAILED if FAILED in {run.state for run in runs} else PRUNED
    if entry.n_running and len(entry.scores) < rules.min_runs:
        return RUNNING
    if len(entry.scores) < rules.min_runs:
        return "incomplete"
    return CONTENDER if entry.number in contenders else BEATEN


def _rank(row: ConfigurationRow, rules: race.RaceRules) -> tuple[bool, bool, float, int]:
    out = row.mean is None or row.verdict in (FAILED, PRUNED)
    mean = 0.0 if row.mean is None else row.mean
    return row.verdict != WINNER, out, -mean if rules.maximize else mean, row.number


def _final_half_width(
    final: tuple[float, ...], entries: Sequence[race.Entry], rules: race.RaceRules
) -> float:
    if not final:
        return math.inf
    entry = race.Entry(-1, final)
    return race.half_width(entry, race.spread_of([entry, *(e for e in entries if e.scores)], rules))
