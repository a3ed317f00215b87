"""Compare groups of runs: which learns better, with which p value, and how many seeds decide."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from scilab_rl.analysis.estimates import (
    AGGREGATES,
    Estimate,
    aggregate,
    curve_band,
    difference,
    permutation_test,
    probability_of_improvement,
    seeds_needed,
    smallest_p,
)
from scilab_rl.analysis.groups import (
    FAILED,
    INCOMPLETE,
    REWARD_TYPE,
    SUCCESS,
    UNFINISHED,
    Group,
    RunRecord,
)
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.results import PRUNED, SOLVED
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.provenance import fingerprint_differences
from scilab_rl.search.scores import Curve, auc, steps_to_threshold

REWARD = "eval/mean_reward"
_SUCCESS_METRICS = ("eval/success_rate", "eval/success_once_rate")
SCORES = ("final", "auc", "steps_to_threshold")
_LAST = 3  # evaluations that make the final value
SIGNIFICANT = 0.05
_SMALLEST_EFFECT = 0.02  # of the range of scores: smaller effects are ignored
_N_POINTS = 60


@dataclass(frozen=True)
class ComparisonSettings:
    """How groups are compared.

    Attributes:
        metric: The metric; None means success where all runs have it, else the mean reward.
        score: ``final`` (mean of the last three evaluations), ``auc`` (mean over training) or
            ``steps_to_threshold``.
        threshold: For the steps.
    """

    metric: str | None = None
    score: str = "final"
    threshold: float = 0.9


@dataclass(frozen=True)
class GroupEstimates:
    """The estimates of one group.

    Attributes:
        label: Its name.
        meaning: What it consists of.
        scores: Per task, one score per run.
        seeds: Per task, the seeds in the same order.
        estimates: ``iqm``, ``mean``, ``median``, ``auc`` and ``steps`` with intervals.
        n_reached: Runs that reached the threshold.
        n_failed: Runs that crashed; they are in no estimate.
        steps: The grid of its curve.
        band: Interquartile mean, lower and upper end of its interval on that grid.
        curves: The evaluations of each run, in the order of scores and seeds.
    """

    label: str
    meaning: str
    scores: tuple[np.ndarray, ...]
    seeds: tuple[tuple[int, ...], ...]
    estimates: Mapping[str, Estimate]
    n_reached: int
    n_failed: int
    steps: np.ndarray
    band: tuple[np.ndarray, np.ndarray, np.ndarray]
    curves: tuple[Curve, ...] = ()

    @property
    def n_runs(self) -> int:
        """Runs that count."""
        return sum(map(len, self.scores))


@dataclass(frozen=True)
class Contrast:
    """The difference of a group from the first one.

    Attributes:
        label: The group.
        paired: Whether runs with the same seed were compared with each other.
        n: Pairs, or the fewer runs of the two groups.
        iqm: Difference of the interquartile means.
        mean: Difference of the means.
        improvement: Probability that a run of this group beats one of the first.
        p: Of the permutation test, corrected for the number of groups (Holm, 1979).
        verdict: ``better``, ``worse`` or ``undecided``.
        more_seeds: How many more runs of each group would decide; 0 when it is decided.
    """

    label: str
    paired: bool
    n: int
    iqm: Estimate
    mean: Estimate
    improvement: Estimate
    p: float
    verdict: str
    more_seeds: int


@dataclass(frozen=True)
class Comparison:
    """Everything that the reports show.

    Attributes:
        metric: The metric.
        settings: How the groups are compared.
        tasks: The tasks in which all of them have runs.
        horizon: Steps up to which they are compared, by task.
        groups: Their estimates.
        contrasts: Their differences from the first.
        notes: What a reader must know.
        runs: One row per run.
        differences: What differs in their configurations: a key, then its value in each group.
    """

    metric: str
    settings: ComparisonSettings
    tasks: tuple[str, ...]
    horizon: Mapping[str, int]
    groups: tuple[GroupEstimates, ...]
    contrasts: tuple[Contrast, ...]
    notes: tuple[str, ...]
    runs: tuple[Mapping[str, object], ...] = field(repr=False, default=())
    differences: tuple[tuple[str, ...], ...] = ()

    @property
    def has_one_length(self) -> bool:
        """Whether the runs of all tasks are equally long."""
        return len(set(self.horizon.values())) == 1


def compare(groups: Sequence[Group], settings: ComparisonSettings) -> Comparison:
    """Compare groups with the first of them.

    Args:
        groups: At least two.
        settings: How they are compared.

    Raises:
        ConfigError: If there is nothing to compare.
    """
    notes = [f"{group.label}: {note}" for group in groups for note in _about_runs(group)]
    usable = [[run for run in group.runs if _counts(run)] for group in groups]
    for group, runs in zip(groups, usable, strict=True):
        if not runs:
            raise ConfigError(f"{group.label} ({group.meaning}) has no finished run.")
    tasks = _common_tasks(groups, usable, notes)
    usable = [[run for run in runs if run.task in tasks] for runs in usable]
    metric = _metric(usable, settings.metric)
    if metric == REWARD:
        _refuse_other_rewards([run for runs in usable for run in runs])
    if len(tasks) > 1 and metric != SUCCESS:
        notes.append(f"the scale of {metric} differs between environments: do not trust its mean")
    horizon = {
        task: min(run.end for runs in usable for run in runs if run.task == task) for task in tasks
    }
    notes += _about_lengths(usable, horizon) + _about_sources(groups, usable)
    estimated = tuple(
        _estimate(group, runs, tasks, horizon, metric, settings)
        for group, runs in zip(groups, usable, strict=True)
    )
    notes += _about_crashes(estimated, metric)
    return Comparison(
        metric, settings, tuple(tasks), horizon, estimated,
        _contrasts(estimated, settings), tuple(notes),
        tuple(_rows(groups, usable, horizon, metric, settings)), _differences(usable),
    )  # fmt: skip


def curve_of(run: RunRecord, metric: str, horizon: int, threshold: float) -> Curve:
    """Return a run's curve up to the horizon."""
    measured = [
        (step, value)
        for step, value in zip(run.steps, _without_gaps(run, metric), strict=True)
        if not math.isnan(value)
    ]
    points = [point for point in measured if point[0] <= horizon] or measured[:1]
    steps, values = zip(*points, strict=True)
    return Curve(steps, values, horizon, threshold)


def _without_gaps(run: RunRecord, metric: str) -> tuple[float, ...]:
    """Return the values; before anything reported success, there was none."""
    values = run.values[metric]
    if not metric.startswith(_SUCCESS_METRICS):
        return values
    return tuple(0.0 if math.isnan(value) else value for value in values)


def score_of(curve: Curve, name: str) -> float:
    """Reduce a run to one number; larger is better for all but ``steps_to_threshold``."""
    if name == "final":
        last = curve.values[-_LAST:]
        return math.fsum(last) / len(last)
    return auc(curve) if name == "auc" else steps_to_threshold(curve)


def _estimate(
    group: Group,
    runs: Sequence[RunRecord],
    tasks: Sequence[str],
    horizon: Mapping[str, int],
    metric: str,
    settings: ComparisonSettings,
) -> GroupEstimates:
    ordered = sorted(runs, key=lambda run: (run.seed, str(run.path)))
    of_task = [[run for run in ordered if run.task == task] for task in tasks]
    curves = [
        [curve_of(run, metric, horizon[run.task], settings.threshold) for run in in_task]
        for in_task in of_task
    ]
    scores = {
        name: tuple(np.array([score_of(curve, name) for curve in task]) for task in curves)
        for name in SCORES
    }
    chosen = scores[settings.score]
    estimates = {name: aggregate(chosen, name) for name in AGGREGATES}
    estimates["auc"] = aggregate(scores["auc"], "iqm")
    estimates["steps"] = aggregate(scores["steps_to_threshold"], "iqm")
    fractions = np.linspace(0, 1, _N_POINTS + 1)[1:]
    on_grid = [
        np.array([_at(curve, fractions * curve.budget) for curve in task]) for task in curves
    ]
    return GroupEstimates(
        label=group.label,
        meaning=group.meaning,
        scores=chosen,
        seeds=tuple(tuple(run.seed for run in in_task) for in_task in of_task),
        estimates=estimates,
        n_reached=sum(max(c.values) >= settings.threshold for task in curves for c in task),
        n_failed=sum(run.status == FAILED for run in group.runs if run.task in tasks),
        steps=fractions * (max(horizon.values()) if len(set(horizon.values())) == 1 else 1),
        band=curve_band(on_grid),
        curves=tuple(curve for task in curves for curve in task),
    )


def mean_curve(curves: Sequence[Curve], *, as_share: bool) -> tuple[list[float], list[float]]:
    """Return the mean over runs at their evaluations, from where all of them have been evaluated.

    Args:
        curves: One per run.
        as_share: Whether steps are given as a share of the training.
    """
    shares = sorted({step / curve.budget for curve in curves for step in curve.steps})
    first = max(curve.steps[0] / curve.budget for curve in curves)
    known = np.array([share for share in shares if share >= first])
    values = np.mean([_at(curve, known * curve.budget + 1e-9) for curve in curves], axis=0)
    return (known * (1 if as_share else curves[0].budget)).tolist(), values.tolist()


def _at(curve: Curve, steps: np.ndarray) -> np.ndarray:
    """Return the newest evaluation at each step; before the first one, the first one."""
    places = np.searchsorted(curve.steps, steps, side="right") - 1
    return np.asarray(curve.values)[np.maximum(places, 0)]


def _contrasts(
    groups: Sequence[GroupEstimates], settings: ComparisonSettings
) -> tuple[Contrast, ...]:
    first, raw = groups[0], []
    level = SIGNIFICANT / (len(groups) - 1)
    for group in groups[1:]:
        ours, theirs, paired = _paired(first, group, level)
        raw.append((group, ours, theirs, paired, permutation_test(ours, theirs, paired=paired)))
    corrected = holm([entry[4] for entry in raw])
    sign = -1 if settings.score == "steps_to_threshold" else 1
    contrasts = []
    for (group, ours, theirs, paired, _), p in zip(raw, corrected, strict=True):
        n = min(min(map(len, ours)), min(map(len, theirs)))
        mean = difference(ours, theirs, "mean", paired=paired)
        decided = p <= SIGNIFICANT and mean.value != 0
        better = mean.value * sign > 0
        spread = np.ptp(np.concatenate([*ours, *theirs]))
        smallest = _SMALLEST_EFFECT * (float(spread) or 1.0)
        needed = min(
            seeds_needed(ours, theirs, paired=as_pairs, at_least=smallest, level=level)
            for as_pairs in {paired, False}
        )
        contrasts.append(
            Contrast(
                group.label, paired, n,
                difference(ours, theirs, "iqm", paired=paired),
                mean,
                probability_of_improvement([sign * x for x in ours], [sign * x for x in theirs]),
                p,
                ("better" if better else "worse") if decided else "undecided",
                0 if decided else max(needed - n, 1),
            )
        )  # fmt: skip
    return tuple(contrasts)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for their number (Holm, 1979, Scandinavian Journal 6).

    >>> holm([0.01, 0.04])
    [0.02, 0.04]
    """
    corrected, largest = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(np.argsort(p_values)):
        largest = max(largest, min(1.0, float(p_values[index]) * (len(p_values) - rank)))
        corrected[int(index)] = largest
    return corrected


def _paired(
    first: GroupEstimates, other: GroupEstimates, level: float
) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray], bool]:
    """Return the scores of both groups, paired by seed if all tasks have common seeds.

    Pairs are used when they leave out at most half of the runs and are enough to decide anything:
    five pairs cannot give a p below 0.06, five runs against five can.
    """
    ours, theirs = [], []
    for task, (left, right) in enumerate(zip(first.seeds, other.seeds, strict=True)):
        common = [seed for seed in left if seed in right]
        if len(common) < 2 or len(common) < min(len(left), len(right)) / 2:
            return first.scores, other.scores, False
        ours.append(first.scores[task][[left.index(seed) for seed in common]])
        theirs.append(other.scores[task][[right.index(seed) for seed in common]])
    n_pairs = sum(map(len, ours))
    if smallest_p(n_pairs, n_pairs, paired=True) > level:
        return first.scores, other.scores, False
    return ours, theirs, True


def _counts(run: RunRecord) -> bool:
    return run.status not in INCOMPLETE and bool(run.steps)


def _common_tasks(
    groups: Sequence[Group], usable: Sequence[Sequence[RunRecord]], notes: list[str]
) -> list[str]:
    tasks_of = [dict.fromkeys(run.task for run in runs) for runs in usable]
    common = [task for task in tasks_of[0] if all(task in tasks for tasks in tasks_of)]
    if not common:
        listed = "; ".join(
            f"{group.label} in {listing(tasks)}"
            for group, tasks in zip(groups, tasks_of, strict=True)
        )
        raise ConfigError(f"The groups have no environment in common: {listed}.")
    left_out = {task for tasks in tasks_of for task in tasks if task not in common}
    if left_out:
        notes.append(f"left out, because not every group has runs there: {listing(left_out)}")
    return common


def _metric(usable: Sequence[Sequence[RunRecord]], wanted: str | None) -> str:
    runs = [run for runs in usable for run in runs]
    common = [name for name in runs[0].values if all(name in run.values for run in runs)]
    if wanted is None:
        return SUCCESS if SUCCESS in common else REWARD
    name = wanted if "/" in wanted else f"eval/{wanted}"
    if name not in common:
        raise ConfigError(
            f"Not all runs have the metric '{name}'.{did_you_mean(name, common)} They share "
            f"{listing(common)}."
        )
    return name


def _refuse_other_rewards(runs: Sequence[RunRecord]) -> None:
    varying = _varying(runs) & {f"env_kwargs.{REWARD_TYPE}"}
    if varying:
        raise ConfigError(
            f"The runs learned from different rewards ({listing(varying)}), so their mean rewards "
            f"do not compare; {SUCCESS} does."
        )


def _about_runs(group: Group) -> list[str]:
    notes = []
    failed = [run for run in group.runs if run.status == FAILED]
    unfinished = [run for run in group.runs if run.status in UNFINISHED]
    if failed:
        notes.append(f"{len(failed)} of {len(group.runs)} runs crashed and are in no estimate")
    if unfinished:
        notes.append(f"{len(unfinished)} runs have not ended and are left out")
    if pruned := sum(run.status == PRUNED for run in group.runs):
        notes.append(f"{pruned} runs were pruned by a study and are left out")
    varying = _varying([run for run in group.runs if _counts(run)])
    if varying:
        notes.append(f"its runs used different configurations: {listing(varying)} differ")
    return notes


def _varying(runs: Sequence[RunRecord]) -> set[str]:
    """Return the keys in which runs of one task differ."""
    varying = set()
    for task in {run.task for run in runs}:
        configs = [run.config for run in runs if run.task == task]
        keys = {key for config in configs for key in config}
        varying |= {key for key in keys if len({config.get(key) for config in configs}) > 1}
    if all(run.status != SOLVED for run in runs):  # none of them has stopped early
        varying = {key for key in varying if not key.startswith("early_stop_")}
    return varying


def _about_lengths(usable: Sequence[Sequence[RunRecord]], horizon: Mapping[str, int]) -> list[str]:
    runs = [run for runs in usable for run in runs]
    notes = []
    longer = sum(run.end > horizon[run.task] for run in runs)
    if longer:
        lengths = ", ".join(f"{steps:,} steps in {task}" for task, steps in horizon.items())
        notes.append(f"{longer} runs are longer than others; all are compared up to {lengths}")
    solved = sum(run.status == SOLVED and run.steps[-1] < horizon[run.task] for run in runs)
    if solved:
        notes.append(
            f"{solved} runs ended as solved before the end of the comparison; they count as if "
            "they had stayed at their last value"
        )
    return notes


def _about_sources(groups: Sequence[Group], usable: Sequence[Sequence[RunRecord]]) -> list[str]:
    notes = fingerprint_differences(RunDirectory(run.path) for runs in usable for run in runs)
    for group, runs in zip(groups[1:], usable[1:], strict=True):
        both = [*usable[0], *runs]
        keys = {key for key in _varying(both) if not key.startswith("algorithm.")}
        if keys:
            notes.append(f"{groups[0].label} and {group.label} differ also in {listing(keys)}")
    return notes


def _differences(usable: Sequence[Sequence[RunRecord]]) -> tuple[tuple[str, ...], ...]:
    """Return the keys in which groups differ, each with its values per group."""
    rows = []
    for key in sorted(_varying([run for runs in usable for run in runs])):
        cells = [sorted({run.config.get(key, "-").strip('"') for run in runs}) for runs in usable]
        if any(cell != cells[0] for cell in cells[1:]):
            rows.append((key, *(" or ".join(cell) for cell in cells)))
    return tuple(rows)


def _about_crashes(groups: Sequence[GroupEstimates], metric: str) -> list[str]:
    if metric != SUCCESS:
        return []
    notes = []
    for group in groups:
        if group.n_failed:
            every = np.concatenate([*group.scores, np.zeros(group.n_failed)])
            notes.append(
                f"{group.label}: with its crashed runs counted as 0 its mean would be "
                f"{every.mean():.3g} and not {group.estimates['mean'].value:.3g}"
            )
    return notes


def _rows(
    groups: Sequence[Group],
    usable: Sequence[Sequence[RunRecord]],
    horizon: Mapping[str, int],
    metric: str,
    settings: ComparisonSettings,
) -> list[dict[str, object]]:
    """Return one row per run, with nothing left out."""
    rows = []
    for group, counted in zip(groups, usable, strict=True):
        for run in group.runs:
            row: dict[str, object] = {
                "group": group.label, "env": run.env, "algorithm": run.algorithm, "seed": run.seed,
                "status": run.status, "counted": run in counted,
            }  # fmt: skip
            if run in counted:
                curve = curve_of(run, metric, horizon[run.task], settings.threshold)
                row |= {name: score_of(curve, name) for name in SCORES}
                row |= {"reached": max(curve.values) >= settings.threshold, "seconds": run.seconds}
            rows.append(row | {"run": str(run.path)})
    return rows
