"""Parameters of each participant: maximum likelihood, or maximum a posteriori with intervals.

All participants and all restarts are one batch of Newton's method, with exact derivatives of the
likelihood. The prior is normal on the real scale of each parameter (see `Parameter`). Intervals and
the evidence of a model come from draws from the posterior (see `posterior`); without a prior,
intervals come from the curvature at the maximum, and there is no evidence.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scilab_rl.analysis.fitting import posterior
from scilab_rl.analysis.fitting.panel import Panel
from scilab_rl.config.classes import find_target
from scilab_rl.config.workspace import config_files
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.learning.cognitive import CognitiveModel, Seen, log_likelihoods

MAP, MLE = "map", "mle"
_FARTHEST = 12.0  # on the real scale, where a probability is 0 or 1 to five digits
_N_ITERATIONS = 60
_N_TRIED = posterior.N_DRAWS  # random places, of which the best are starts: the same shape
N_BATCHES = 5  # restarts, and folds: one shape, compiled once
Z_95 = 1.959964


@dataclass(frozen=True)
class Fit:
    """The estimates of a model for all participants.

    Attributes:
        name: The model's name.
        model: The model.
        panel: The choices.
        real: Estimates on the real scale. Shapes: ``(n_participants, n_parameters)``.
        low, high: Ends of their 95 % intervals, as above.
        log_likelihood: At the estimates. Shapes: ``(n_participants,)``.
        log_evidence: NaN for maximum likelihood. Shapes as above.
        n_effective: Effective draws from the posterior; NaN for maximum likelihood. Shapes as
            above.
        converged: Whether the gradient is zero there. Shapes as above.
        n_agreeing: Restarts that ended in the same place. Shapes as above.
    """

    name: str
    model: type[CognitiveModel]
    panel: Panel
    real: np.ndarray
    low: np.ndarray
    high: np.ndarray
    log_likelihood: np.ndarray
    log_evidence: np.ndarray
    n_effective: np.ndarray
    converged: np.ndarray
    n_agreeing: np.ndarray

    @property
    def n_parameters(self) -> int:
        """Free parameters per participant."""
        return self.real.shape[1]

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The estimates, by parameter. Shapes: ``(n_participants,)`` each."""
        return natural(self.model, self.real)

    @property
    def intervals(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The ends of the 95 % intervals, by parameter."""
        low, high = natural(self.model, self.low), natural(self.model, self.high)
        return {name: (low[name], high[name]) for name in low}

    @property
    def bic(self) -> np.ndarray:
        """The Bayesian information criterion; smaller is better. Shapes: ``(n_participants,)``."""
        return -2 * self.log_likelihood + self.n_parameters * np.log(self.panel.n_choices)

    @property
    def aic(self) -> np.ndarray:
        """Akaike's information criterion; smaller is better. Shapes: ``(n_participants,)``."""
        return -2 * self.log_likelihood + 2 * self.n_parameters


def find_model(name: str) -> type[CognitiveModel]:
    """Return the model of a name.

    Raises:
        ConfigError: If there is no such algorithm, or it is not a cognitive model.
    """
    import yaml

    options = config_files("algorithm")
    models = [n for n in options if n.islower()]
    if name not in options:
        raise ConfigError(f"There is no model '{name}'.{did_you_mean(name, models)} {_models()}")
    target = (yaml.safe_load(options[name].read_text(encoding="utf-8")) or {}).get("_target_")
    cls = find_target(target, f"{options[name]}: _target_")
    if not (isinstance(cls, type) and issubclass(cls, CognitiveModel)):
        raise ConfigError(
            f"'{name}' is an algorithm that has no likelihood of choices. {_models()}"
        )
    return cls


def _models() -> str:
    folder = ".algorithms.models."
    shipped = [n for n, p in config_files("algorithm").items() if folder in p.read_text("utf-8")]
    return f"Models: {', '.join(shipped)}."


def natural(model: type[CognitiveModel], real: np.ndarray) -> dict[str, np.ndarray]:
    """Return parameters, by name, from their real scale. Shapes: real: ``(..., n_parameters)``."""
    items = model.parameters.items()
    return {name: p.from_real(real[..., k], np) for k, (name, p) in enumerate(items)}


def prior_draws(model: type[CognitiveModel], n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw parameters from the prior, on the real scale. Shapes: ``(n, n_parameters)``."""
    return rng.normal(*_prior(model), (n, len(model.parameters)))


def check_panel(name: str, model: type[CognitiveModel], panel: Panel) -> None:
    """Reject a model that cannot be one of these choices.

    Raises:
        ConfigError: With a model that can.
    """
    if model.n_stages != panel.n_stages:
        hint = "hybrid" if panel.n_stages == 2 else "rescorlawagner"
        raise ConfigError(
            f"{name} is a model of {model.n_stages} choice(s) per trial, but the table has "
            f"{panel.n_stages}; use model={hint}."
        )


def fit(
    model: str | type[CognitiveModel],
    panel: Panel,
    *,
    method: str = MAP,
    n_restarts: int = N_BATCHES,
    seed: int = 0,
) -> Fit:
    """Estimate the parameters of each participant.

    Args:
        model: The model, or its name.
        panel: The choices.
        method: ``map``, or ``mle`` without the prior.
        n_restarts: Random starts per participant.
        seed: Of the starts.

    Raises:
        ConfigError: If the model cannot be one of these choices.
    """
    name, model = (
        (model, find_model(model)) if isinstance(model, str) else (model.__name__.lower(), model)
    )
    check_panel(name, model, panel)
    starts = _good_starts(model, panel, method, n_restarts, seed)
    x, loss, gradient, hessian = minimize(model, panel, method, starts)
    people, best = np.arange(len(x)), loss.argmin(axis=1)
    real, minimum, curved = x[people, best], loss[people, best], hessian[people, best]
    at_edge = np.abs(real).max(axis=1, initial=0.0) >= _FARTHEST
    flat = np.abs(gradient[people, best]).max(axis=1, initial=0.0) < 1e-3
    around = _posterior if method == MAP else _curvature_only
    return Fit(
        name=name,
        model=model,
        panel=panel,
        real=real,
        log_likelihood=-minimum - (_log_prior(model, real) if method == MAP else 0.0),
        converged=flat & ~at_edge,
        n_agreeing=(loss < minimum[:, None] + 1e-3).sum(axis=1),
        **around(model, panel, real, curved, seed),
    )


def _posterior(
    model: type[CognitiveModel], panel: Panel, real: np.ndarray, hessian: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Return what draws from the posterior say: intervals, evidence and their number."""
    mean, sd = _prior(model)
    volume = np.log(sd).sum()

    def log_joint(z: np.ndarray) -> np.ndarray:
        return volume - _losses(model, panel, MAP, mean + sd * z)

    rng = np.random.default_rng(seed)
    draws = posterior.sample(log_joint, (real - mean) / sd, hessian * np.outer(sd, sd), rng)
    return {
        "low": mean + sd * draws.quantile(0.025),
        "high": mean + sd * draws.quantile(0.975),
        "log_evidence": draws.log_evidence,
        "n_effective": draws.n_effective,
    }


def _curvature_only(
    model: type[CognitiveModel], panel: Panel, real: np.ndarray, hessian: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Return intervals of a normal likelihood (Wald), and that there is no posterior."""
    covariance = np.linalg.pinv(hessian, hermitian=True)
    error = Z_95 * np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    none = np.full(len(real), np.nan)
    return {"low": real - error, "high": real + error, "log_evidence": none, "n_effective": none}


def minimize(
    model: type[CognitiveModel],
    panel: Panel,
    method: str,
    starts: np.ndarray,
    counts: np.ndarray | None = None,
) -> tuple[np.ndarray, ...]:
    """Minimize the negative log-posterior, or log-likelihood, from several starts at once.

    Args:
        model: The model.
        panel: The choices.
        method: ``map`` or ``mle``.
        starts: On the real scale.
        counts: Weights of the choices for each start, if not those of the panel.

    Returns:
        Minima, and values, gradients and Hessians there.

    Shapes:
        starts: ``(n_participants, k, n_parameters)``; counts: ``(n_participants, k, n_choices)``;
        results: ``(n_participants, k, ...)``.
    """
    n, k, d = starts.shape
    objective = _objective(model, panel.n_states, panel.n_actions, method == MAP)
    data = jax.tree.map(lambda table: np.repeat(table, k, axis=0), (panel.seen, panel.responses))
    weights = np.repeat(panel.counts, k, axis=0) if counts is None else counts.reshape(n * k, -1)
    with jax.enable_x64(True):
        found = _newton(lambda x: objective.curvature(x, *data, weights), starts.reshape(n * k, d))
    return tuple(table.reshape(n, k, *table.shape[1:]) for table in found)


def _log_prior(model: type[CognitiveModel], real: np.ndarray) -> np.ndarray:
    mean, sd = _prior(model)
    return (-0.5 * (((real - mean) / sd) ** 2 + np.log(2 * np.pi * sd**2))).sum(axis=1)


@dataclass(frozen=True)
class _Objective:
    """What is minimized, compiled: for several points per participant, and for one each."""

    loss: Callable[..., Any]
    curvature: Callable[..., Any]


@functools.cache
def _objective(
    model: type[CognitiveModel], n_states: int, n_actions: int, has_prior: bool
) -> _Objective:
    mean, sd = _prior(model)

    def log_likelihood(x: Any, seen: Seen, responses: Any, counts: Any) -> Any:
        values = {name: p.from_real(x[k]) for k, (name, p) in enumerate(model.parameters.items())}
        each = log_likelihoods(model, n_states, n_actions, values, seen, responses)
        return (each * counts).sum()

    def loss(x: Any, *data: Any) -> Any:
        prior = -0.5 * (((x - mean) / sd) ** 2 + jnp.log(2 * jnp.pi * sd**2))
        return -log_likelihood(x, *data) - (prior.sum() if has_prior else 0.0)

    def curvature(x: Any, *data: Any) -> Any:
        def with_value(x: Any) -> Any:
            value, slope = jax.value_and_grad(loss)(x, *data)
            return slope, (value, slope)

        hessian, (value, slope) = jax.jacfwd(with_value, has_aux=True)(x)
        return value, slope, hessian

    losses = jax.vmap(loss, (0, None, None, None))
    return _Objective(*(jax.jit(jax.vmap(function)) for function in (losses, curvature)))


def _prior(model: type[CognitiveModel]) -> tuple[np.ndarray, np.ndarray]:
    parameters = model.parameters.values()
    return np.array([p.mean for p in parameters]), np.array([p.sd for p in parameters])


def _good_starts(
    model: type[CognitiveModel], panel: Panel, method: str, k: int, seed: int
) -> np.ndarray:
    """Return the best draws from the prior. Shapes: ``(n_participants, k, n_parameters)``."""
    tried = prior_draws(model, max(_N_TRIED, k), np.random.default_rng(seed))
    losses = _losses(model, panel, method, np.tile(tried, (len(panel.participants), 1, 1)))
    return tried[np.argsort(losses, axis=1)[:, :k]]


def _losses(model: type[CognitiveModel], panel: Panel, method: str, x: np.ndarray) -> np.ndarray:
    """Return what is minimized.

    Shapes:
        x: ``(n_participants, k, n_parameters)``; result: ``(n_participants, k)``.
    """
    objective = _objective(model, panel.n_states, panel.n_actions, method == MAP)
    with jax.enable_x64(True):
        return np.asarray(objective.loss(x, panel.seen, panel.responses, panel.counts))


def _newton(
    evaluate: Callable[[np.ndarray], Any], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Minimize a batch of functions by damped Newton steps along the positive curvature.

    Args:
        evaluate: Returns values, gradients and Hessians.
        x: The starts.

    Shapes:
        x: ``(n, d)``; results, the minima and what `evaluate` says of them: ``(n, d)``, ``(n,)``,
        ``(n, d)``, ``(n, d, d)``.
    """
    value, slope, hessian = map(np.array, evaluate(x))
    damping = np.full(len(x), 1e-2)
    for _ in range(_N_ITERATIONS):
        eigenvalues, vectors = np.linalg.eigh(hessian)
        stiffness = np.maximum(np.abs(eigenvalues), 1e-6) + damping[:, None]
        step = -np.einsum("nij,nj,nkj,nk->ni", vectors, 1 / stiffness, vectors, slope)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        tried = np.clip(x + step * np.minimum(1.0, 2.0 / np.maximum(length, 1e-12)), -12.0, 12.0)
        new_value, new_slope, new_hessian = map(np.asarray, evaluate(tried))
        better = (new_value < value) & np.isfinite(new_hessian).all(axis=(1, 2))
        small = np.abs(slope).max(axis=1, initial=0.0) < 1e-6
        gained = np.where(better, value - new_value, np.where(damping > 1e6, 0.0, np.inf))
        x, value = np.where(better[:, None], tried, x), np.where(better, new_value, value)
        slope = np.where(better[:, None], new_slope, slope)
        hessian = np.where(better[:, None, None], new_hessian, hessian)
        damping = np.where(better, damping * 0.1, damping * 10.0)
        if (small | (gained < 1e-9)).all():
            break
    return x, value, slope, hessian
