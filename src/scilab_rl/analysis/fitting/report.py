"""The results of fits and recoveries as tables and pages."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.analysis.fitting import recovery as recoveries
from scilab_rl.analysis.fitting.behavior import condition_rows, curve_charts
from scilab_rl.analysis.fitting.estimation import MAP, Fit, fit
from scilab_rl.analysis.fitting.hierarchical import Posterior, sample_posterior
from scilab_rl.analysis.fitting.inference_data import (
    LeaveOneOut,
    import_arviz,
    leave_one_out,
    make_inference_data,
    write_inference_data,
)
from scilab_rl.analysis.fitting.panel import Panel
from scilab_rl.analysis.fitting.posterior import ENOUGH
from scilab_rl.analysis.fitting.predictive import (
    Behavior,
    Curve,
    simulated_panel,
    size_of,
    stay_probabilities,
    task_behavior,
    task_curves,
)
from scilab_rl.analysis.fitting.recovery import Recovery
from scilab_rl.analysis.fitting.selection import (
    HeldOut,
    Selection,
    choice_probabilities,
    held_out,
    select,
)
from scilab_rl.analysis.report import write_table
from scilab_rl.charts import Series
from scilab_rl.files import write_text
from scilab_rl.pages import render

_log = logging.getLogger(__name__)
Row = Mapping[str, object]
MODEL_COLUMNS = (
    "model", "parameters", "AIC", "BIC", "held-out P", "accuracy", "LOO P", "bad k", "frequency",
    "PXP", "converged",
)  # fmt: skip
GROUP_COLUMNS = ("model", "parameter", "group mean", "low", "high")
RECOVERY_COLUMNS = (
    "model", "parameter", "r", "r, real scale", "bias", "RMSE", "coverage of 95 % intervals",
)  # fmt: skip
_PEOPLE = "data"
_FEW = 0.95  # exceedance probability that counts as a decision


@dataclass
class FitResults:
    """All that is known after several models were fitted to the same choices.

    Attributes:
        panel: The choices.
        fits: One per model.
        held_out: Predictions of left-out choices, one per model.
        selection: Random-effects comparison; None with a single model or without evidence.
        behavior: What was done, and what each model does: condition to shares per participant.
        curves: How that changes, in the same order; only of the data without a known task.
        simulated: Whether the models' behavior is simulated, or expected given the actual trials.
        posteriors: Hierarchical samples, one per model, if requested.
        inference_data: The same for ArviZ.
        left_out: What PSIS-LOO says of them.
        recovery: Sentences about the recovery of the models.
    """

    panel: Panel
    fits: list[Fit]
    held_out: list[HeldOut]
    selection: Selection | None
    behavior: dict[str, Behavior]
    curves: dict[str, list[Curve]]
    simulated: bool
    posteriors: list[Posterior] = field(default_factory=list)
    inference_data: list[Any] = field(default_factory=list)
    left_out: list[LeaveOneOut] = field(default_factory=list)
    recovery: list[str] = field(default_factory=list)

    @property
    def problems(self) -> list[str]:
        """Why nothing may be concluded from the hierarchical samples."""
        return [f"{p.name}: {p.problem}" for p in self.posteriors if p.problem]


def fit_all(
    panel: Panel,
    models: Sequence[str],
    *,
    method: str = MAP,
    hierarchical: bool = False,
    env: str = "",
    env_kwargs: Mapping[str, Any] | None = None,
    seed: int = 0,
    base: Path = Path("data"),
    sampling: Mapping[str, int] | None = None,
) -> FitResults:
    """Fit several models and compare them.

    Args:
        panel: The choices.
        models: Names.
        method: ``map`` or ``mle``.
        hierarchical: Whether NUTS samples the populations too.
        env: The task in which fitted models act; empty: that of the table, if it names one.
        env_kwargs: Its arguments.
        seed: Of starts, folds, simulations and samplers.
        base: Where recovery results are kept.
        sampling: Arguments of `hierarchical.sample_posterior`.
    """
    fits = [fit(name, panel, method=method, seed=seed) for name in models]
    posteriors = []
    if hierarchical:
        import_arviz()  # before minutes of sampling
        for fitted in fits:
            _log.info("%s: sampling the population.", fitted.name)
            posteriors.append(sample_posterior(fitted, seed=seed, **(sampling or {})))
    samples = [make_inference_data(p) for p in posteriors]
    behavior, curves, simulated = _behavior(panel, fits, env or panel.env, env_kwargs or {}, seed)
    evidence = np.stack([_score(fitted) for fitted in fits], axis=1)
    n_trials = float(np.mean(panel.n_choices)) / panel.n_stages
    return FitResults(
        panel=panel,
        fits=fits,
        held_out=[held_out(fitted, method=method, seed=seed) for fitted in fits],
        selection=select(evidence, seed=seed) if len(fits) > 1 else None,
        behavior=behavior,
        curves=curves,
        simulated=simulated,
        posteriors=posteriors,
        inference_data=samples,
        left_out=list(map(leave_one_out, posteriors, samples)),
        recovery=[recoveries.sentence(name, n_trials, base) for name in models],
    )


def _score(fitted: Fit) -> np.ndarray:
    """Return the evidence; -BIC / 2 where there is none. Shapes: ``(n_participants,)``."""
    has_evidence = np.isfinite(fitted.log_evidence)
    return np.where(has_evidence, fitted.log_evidence, -0.5 * fitted.bic)


def _behavior(
    panel: Panel, fits: Sequence[Fit], env: str, env_kwargs: Mapping[str, Any], seed: int
) -> tuple[dict[str, Behavior], dict[str, list[Curve]], bool]:
    curves = {_PEOPLE: task_curves(panel)}
    if env:
        behavior = {_PEOPLE: task_behavior(panel)}
        for fitted in fits:
            acted = simulated_panel(
                fitted.model, fitted.values, size_of(panel), env, env_kwargs, seed
            )
            behavior[fitted.name] = task_behavior(acted)
            curves[fitted.name] = task_curves(acted)
    else:
        behavior = {_PEOPLE: stay_probabilities(panel)}
        for fitted in fits:
            expected = choice_probabilities(fitted.model, panel, fitted.values)
            behavior[fitted.name] = stay_probabilities(panel, expected)
    return behavior, curves, bool(env)


def model_rows(results: FitResults) -> list[dict[str, object]]:
    """Return the table of the models."""
    rows = []
    for index, (fitted, test) in enumerate(zip(results.fits, results.held_out, strict=True)):
        rows.append(
            {
                "model": fitted.name,
                "parameters": fitted.n_parameters,
                "log-likelihood": f"{fitted.log_likelihood.sum():.1f}",
                "AIC": f"{fitted.aic.sum():.1f}",
                "BIC": f"{fitted.bic.sum():.1f}",
                "held-out P": round(float(np.exp(test.log_probability.mean())), 3),
                "accuracy": round(float(test.accuracy.mean()), 3),
                "converged": f"{int(fitted.converged.sum())}/{len(fitted.converged)}",
            }
        )
        if results.left_out:
            left_out = results.left_out[index]
            rows[-1] |= {
                "elpd LOO": f"{left_out.elpd:.1f}",
                "SE": f"{left_out.error:.1f}",
                "LOO P": round(float(np.exp(left_out.elpd / left_out.n_choices)), 3),
                "bad k": f"{left_out.n_bad}/{left_out.n_choices}",
            }
        if results.selection is not None:
            rows[-1] |= {
                "frequency": round(float(results.selection.frequencies[index]), 3),
                "PXP": round(float(results.selection.protected[index]), 3),
            }
    return rows


def group_rows(results: FitResults) -> list[dict[str, object]]:
    """Return the group means: sampled ones, or means of the single estimates."""
    if results.posteriors:
        return [row for posterior in results.posteriors for row in posterior.group_rows()]
    rows = []
    for fitted in results.fits:
        for name, values in fitted.values.items():
            error = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
            mean = float(values.mean())
            rows.append(
                {
                    "model": fitted.name,
                    "parameter": name,
                    "group mean": mean,
                    "low": mean - float(error),
                    "high": mean + float(error),
                }
            )
    return rows


def participant_rows(results: FitResults) -> list[dict[str, object]]:
    """Return a row per participant, model and parameter."""
    rows: list[dict[str, object]] = []
    for fitted in results.fits:
        intervals = fitted.intervals
        for name, values in fitted.values.items():
            low, high = intervals[name]
            rows += [
                {
                    "participant_id": code,
                    "model": fitted.name,
                    "parameter": name,
                    "estimate": float(values[index]),
                    "low": float(low[index]),
                    "high": float(high[index]),
                    "log_likelihood": float(fitted.log_likelihood[index]),
                    "bic": float(fitted.bic[index]),
                    "converged": bool(fitted.converged[index]),
                }
                for index, code in enumerate(results.panel.participants)
            ]
    return rows


def conclusions(results: FitResults) -> list[str]:
    """Return what follows; nothing does if the samples are bad or no model stands out."""
    if results.problems:
        return [f"No conclusion: {'; '.join(results.problems)}. Sample longer."]
    n = len(results.panel.participants)
    if results.selection is None:
        fitted, test = results.fits[0], results.held_out[0]
        return [
            f"{fitted.name} expects {test.accuracy.mean():.0%} of the held-out choices of {n} "
            f"participants; compare it with others, such as randomchoice: model={fitted.name},"
            "randomchoice."
        ]
    best = int(results.selection.protected.argmax())
    name, p = results.fits[best].name, float(results.selection.protected[best])
    if p < _FEW:
        return [
            f"Undecided: {name} is the most frequent model with a protected exceedance probability "
            f"of {p:.2f}, which is below {_FEW}."
        ]
    share = results.selection.frequencies[best]
    return [
        f"{name} is the most frequent model of {n} participants (protected exceedance probability "
        f"{p:.3f}, estimated frequency {share:.0%})."
    ]


def fit_page(results: FitResults, title: str) -> str:
    """Return one HTML file."""
    panel = results.panel
    kind = (
        "the models act in the same task with the estimated parameters"
        if results.simulated
        else "the models are asked before each actual choice, because no task is named (env=TASK)"
    )
    n_free = int(panel.n_choices.sum())
    people = participant_rows(results)
    columns = ("participant_id", "model", "parameter", "estimate", "low", "high", "converged")
    return render(
        "fit.html",
        title=title,
        conclusions=conclusions(results),
        about=f"{len(panel.participants)} participants, {n_free} free choices among "
        f"{panel.n_actions} responses.",
        models=_table(MODEL_COLUMNS, model_rows(results)),
        models_caption="Smaller AIC and BIC, and larger probabilities of held-out choices, are "
        "better. LOO P, with hierarchical=true: probability of a choice given all others; "
        "it is unreliable for choices with a bad Pareto k. Frequency: estimated share of "
        "participants with the model. PXP: protected exceedance probability, that it is the most "
        "frequent one (Rigoux et al., 2014).",
        choices=condition_rows(results.behavior),
        choices_caption=f"Means over participants with 95 % intervals; {kind}.",
        curves=curve_charts(results.curves),
        groups=_table(GROUP_COLUMNS, group_rows(results)),
        quality=_quality(results),
        recovery=results.recovery,
        participants=_table(columns, people),
    )


def _quality(results: FitResults) -> str:
    lines = [
        f"{p.name}: largest R-hat {max(p.r_hat.values()):.3f}, smallest effective sample size "
        f"{min(p.effective.values()):.0f}, {p.n_divergent} divergent transitions."
        for p in results.posteriors
    ]
    for fitted in results.fits:
        if n_few := int((fitted.n_effective < ENOUGH).sum()):
            lines.append(
                f"{fitted.name}: the intervals of {n_few} participants are rough, from fewer than "
                f"{ENOUGH:.0f} effective draws."
            )
    return " ".join(lines)


def write_fit(
    results: FitResults,
    folder: Path,
    title: str,
    *,
    parquet: bool = False,
    arviz: bool = False,
) -> Path:
    """Write the page, the tables and perhaps the samples into a folder; return the page."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "fit.html", fit_page(results, title))
    suffixes = (".csv", ".parquet") if parquet else (".csv",)
    for suffix in suffixes:
        write_table(model_rows(results), folder / f"models{suffix}")
        write_table(group_rows(results), folder / f"groups{suffix}")
        write_table(participant_rows(results), folder / f"participants{suffix}")
    if arviz:
        for posterior, samples in zip(results.posteriors, results.inference_data, strict=True):
            write_inference_data(samples, folder / f"{posterior.name}.nc")
    return folder / "fit.html"


def write_recovery(recovery: Recovery, base: Path) -> Path:
    """Keep a recovery and write its page and tables; return the page."""
    path = recoveries.save(recovery, base)
    write_table(recovery.rows(), path.with_suffix(".csv"))
    write_text(path.with_suffix(".html"), recovery_page(recovery))
    return path.with_suffix(".html")


def recovery_page(recovery: Recovery) -> str:
    """Return one HTML file."""
    scatters = []
    for found in recovery.parameters:
        numbers = [*found.true, *found.estimated]
        range_ = (float(min(numbers)), float(max(numbers)))
        diagonal = Series("equal", mean=(range_, range_), color=4)
        order = np.argsort(found.true)
        points = [([found.true[i]], [found.estimated[i]]) for i in order]
        title = f"{found.parameter} of {found.model}"
        scatters.append((title, [Series(found.parameter, lines=points), diagonal], range_))
    return render(
        "recovery.html",
        title=f"Recovery of {', '.join(recovery.models)}",
        about=f"{recovery.n_participants} simulated participants per model in {recovery.env}, "
        f"{recovery.n_trials} trials each, with parameters from the prior.",
        parameters=_table(RECOVERY_COLUMNS, recovery.rows()),
        confusion=_table(("simulated", *recovery.models), recovery.confusion_rows()),
        scatters=scatters,
    )


def _table(columns: Sequence[str], rows: Sequence[Row]) -> tuple[Sequence[str], list[list[object]]]:
    """Return the columns that any row has, and the rows."""
    known = [name for name in columns if any(name in row for row in rows)]
    return known, [[row.get(name) for name in known] for row in rows]
