"""Whether a design can tell parameters and models apart: simulate, fit, compare with the truth.

Wilson & Collins (2019, eLife 8) ask for this before any fit of people's choices is believed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl import files
from scilab_rl.analysis.fitting.estimation import MAP, Fit, find_model, fit, natural, prior_draws
from scilab_rl.analysis.fitting.panel import make_panel
from scilab_rl.analysis.fitting.simulation import simulate

FOLDER = "recovery"


@dataclass(frozen=True)
class Recovered:
    """How well a parameter is recovered.

    Attributes:
        model: The model.
        parameter: Its parameter.
        correlation: Pearson's, of true and estimated values on the parameter's own scale.
        correlation_real: The same on its real scale, where outliers count less.
        bias: Mean of estimate minus truth.
        rmse: Root of the mean squared error.
        coverage: Share of 95 % intervals that hold the truth.
        true: The true values.
        estimated: The estimates.
    """

    model: str
    parameter: str
    correlation: float
    correlation_real: float
    bias: float
    rmse: float
    coverage: float
    true: list[float]
    estimated: list[float]


@dataclass(frozen=True)
class Recovery:
    """The recovery of parameters and models by a design.

    Attributes:
        models: Names.
        env: The task.
        n_participants: Simulated participants per model.
        n_trials: Trials of each.
        env_kwargs: Further arguments of the task.
        parameters: A row per parameter.
        confusion: Share of the participants of each model (rows) for whom each model (columns) has
            the most evidence.
    """

    models: tuple[str, ...]
    env: str
    n_participants: int
    n_trials: int
    env_kwargs: Mapping[str, Any]
    parameters: tuple[Recovered, ...]
    confusion: np.ndarray

    def rows(self) -> list[dict[str, object]]:
        """Return the table of the parameters."""
        return [
            {
                "model": found.model,
                "parameter": found.parameter,
                "r": round(found.correlation, 3),
                "r, real scale": round(found.correlation_real, 3),
                "bias": round(found.bias, 3),
                "RMSE": round(found.rmse, 3),
                "coverage of 95 % intervals": round(found.coverage, 3),
            }
            for found in self.parameters
        ]

    def confusion_rows(self) -> list[dict[str, object]]:
        """Return the confusion matrix as a table."""
        return [
            {"simulated": name, **dict(zip(self.models, map(float, shares.round(3)), strict=True))}
            for name, shares in zip(self.models, self.confusion, strict=True)
        ]


def recover(
    models: Sequence[str],
    env: str,
    *,
    n_participants: int = 100,
    n_trials: int = 200,
    env_kwargs: Mapping[str, Any] | None = None,
    method: str = MAP,
    seed: int = 0,
) -> Recovery:
    """Simulate participants with parameters from the prior, and fit all models to all of them.

    Args:
        models: Names.
        env: Id of the task.
        n_participants: Simulated participants per model.
        n_trials: Trials of each participant.
        env_kwargs: Further arguments of the task.
        method: As in `fit`; the confusion matrix of ``mle`` uses BIC.
        seed: Of parameters, tasks and choices.

    Raises:
        ConfigError: If a model cannot act in the task.
    """
    found: list[Recovered] = []
    confusion = np.zeros((len(models), len(models)))
    for index, name in enumerate(models):
        model, rng = find_model(name), np.random.default_rng([seed, index])
        real = prior_draws(model, n_participants, rng)
        rows = simulate(
            model, natural(model, real), env,
            n_trials=n_trials, env_kwargs=env_kwargs, seed=seed + index,
        )  # fmt: skip
        panel = make_panel(rows, f"the choices of {name}")
        fits = [fit(other, panel, method=method, seed=seed) for other in models]
        found += compare_with_truth(fits[index], real)
        scores = np.stack([-f.bic if method != MAP else f.log_evidence for f in fits], axis=1)
        best = np.where(np.isfinite(scores), scores, -np.inf).argmax(axis=1)
        confusion[index] = np.bincount(best, minlength=len(models)) / n_participants
    return Recovery(
        models=tuple(models),
        env=env,
        n_participants=n_participants,
        n_trials=n_trials,
        env_kwargs=dict(env_kwargs or {}),
        parameters=tuple(found),
        confusion=confusion,
    )


def compare_with_truth(fitted: Fit, real: np.ndarray) -> list[Recovered]:
    """Return how well each parameter of a fit is recovered.

    Args:
        fitted: To simulated choices.
        real: The true parameters, on the real scale.

    Shapes:
        real: ``(n_participants, n_parameters)``.
    """
    truth, estimates, intervals = natural(fitted.model, real), fitted.values, fitted.intervals
    found = []
    for column, name in enumerate(truth):
        true, estimated, (low, high) = truth[name], estimates[name], intervals[name]
        found.append(
            Recovered(
                model=fitted.name,
                parameter=name,
                correlation=_correlation(true, estimated),
                correlation_real=_correlation(real[:, column], fitted.real[:, column]),
                bias=float(np.mean(estimated - true)),
                rmse=float(np.sqrt(np.mean((estimated - true) ** 2))),
                coverage=float(np.mean((low <= true) & (true <= high))),
                true=true.tolist(),
                estimated=estimated.tolist(),
            )
        )
    return found


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])


def save(recovery: Recovery, base: Path) -> Path:
    """Keep a result, so that a fit of the same models can name it. Returns its file."""
    task = recovery.env.replace(":", "-").replace("/", "-")
    size = f"{recovery.n_participants}x{recovery.n_trials}"
    path = base / FOLDER / f"{task}-{'-'.join(recovery.models)}-{size}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {
        "models": list(recovery.models),
        "env": recovery.env,
        "env_kwargs": dict(recovery.env_kwargs),
        "n_participants": recovery.n_participants,
        "n_trials": recovery.n_trials,
        "parameters": recovery.rows(),
        "confusion": recovery.confusion.round(4).tolist(),
    }
    files.write_json(path, about)
    return path


def nearest(model: str, n_trials: float, base: Path) -> dict[str, Any] | None:
    """Return the kept result of a model whose number of trials is nearest, or None."""
    files_kept = sorted((base / FOLDER).glob("*.json"))
    kept = [json.loads(path.read_text(encoding="utf-8")) for path in files_kept]
    known = [result for result in kept if model in result["models"]]
    return min(known, key=lambda r: abs(np.log(r["n_trials"] / n_trials)), default=None)


def sentence(model: str, n_trials: float, base: Path) -> str:
    """Return what is known of the recovery of a model, as a sentence."""
    result = nearest(model, n_trials, base)
    if result is None:
        return (
            f"{model}: no recovery is known. `scilab-rl recover model={model} env=TASK "
            f"n_trials={n_trials:.0f}` says whether such choices can determine its parameters."
        )
    parts = [
        f"{row['parameter']} r = {row['r']}"
        for row in result["parameters"]
        if row["model"] == model
    ]
    return (
        f"{model}: recovered in {result['env']} with {result['n_trials']} trials: "
        f"{', '.join(parts)}."
    )
