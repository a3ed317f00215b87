"""Which model is the best one: information criteria, held-out choices, random-effects selection."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy.special import digamma, gammaln

from scilab_rl.analysis.fitting.estimation import MAP, N_BATCHES, Fit, minimize, natural
from scilab_rl.analysis.fitting.panel import Panel
from scilab_rl.learning.cognitive import CognitiveModel, log_probabilities

_N_DRAWS = 100_000


@dataclass(frozen=True)
class HeldOut:
    """How well choices are predicted that were not used for the estimates.

    Attributes:
        log_probability: Mean log-probability of a choice. Shapes: ``(n_participants,)``.
        accuracy: Share of choices that were the most probable one. Shapes as above.
    """

    log_probability: np.ndarray
    accuracy: np.ndarray


@dataclass(frozen=True)
class Selection:
    """Random-effects comparison of models (Stephan et al., 2009; Rigoux et al., 2014, NeuroImage).

    Attributes:
        frequencies: Estimated share of participants with each model.
        exceedance: Probability that a model is the most frequent one.
        protected: The same, protected against differences that chance explains.
        p_equal: Probability that all models are equally frequent (Bayesian omnibus risk).
    """

    frequencies: np.ndarray
    exceedance: np.ndarray
    protected: np.ndarray
    p_equal: float


def held_out(fitted: Fit, *, method: str = MAP, seed: int = 0) -> HeldOut:
    """Estimate again without a fifth of the choices, and predict these from all trials before them.

    Args:
        fitted: Where to begin.
        method: As in `fit`.
        seed: Of the division into fifths.
    """
    panel, model, k = fitted.panel, fitted.model, N_BATCHES
    even = np.tile(np.arange(panel.counts.shape[1]) % k, (len(panel.counts), 1))
    folds = np.random.default_rng(seed).permuted(even, axis=1)
    is_out = folds[:, None] == np.arange(k)[:, None]
    starts = np.repeat(fitted.real[:, None], k, axis=1)
    real = minimize(model, panel, method, starts, panel.counts[:, None] * ~is_out)[0]
    total, right = np.zeros((2, len(panel.counts)))
    for fold in range(k):
        test = panel.counts * is_out[:, fold]
        probabilities = choice_probabilities(model, panel, natural(model, real[:, fold]))
        chosen = np.take_along_axis(probabilities, panel.responses[..., None], axis=2)[..., 0]
        total += (np.log(np.maximum(chosen, 1e-300)) * test).sum(axis=1)
        right += ((chosen >= probabilities.max(axis=2) - 1e-12) * test).sum(axis=1)
    return HeldOut(total / panel.n_choices, right / panel.n_choices)


def choice_probabilities(
    model: type[CognitiveModel], panel: Panel, values: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the probabilities of all responses before each choice.

    Args:
        model: The model.
        panel: The choices.
        values: Parameters of the participants, by name.

    Shapes:
        values: ``(n_participants,)``; result: ``(n_participants, n_choices, n_actions)``.
    """
    each = _compiled(model, panel.n_states, panel.n_actions)
    return np.exp(np.asarray(each({k: np.asarray(v) for k, v in values.items()}, panel.seen)))


@functools.cache
def _compiled(model: type[CognitiveModel], n_states: int, n_actions: int) -> Callable[..., Any]:
    return jax.jit(jax.vmap(functools.partial(log_probabilities, model, n_states, n_actions)))


def select(log_evidence: np.ndarray, *, seed: int = 0) -> Selection:
    """Compare models whose frequencies in the population are unknown.

    Args:
        log_evidence: Of each model for each participant.
        seed: Of the draws for the exceedance probabilities.

    Shapes:
        log_evidence: ``(n_participants, n_models)``.
    """
    k = log_evidence.shape[1]
    alpha, responsibilities = _posterior_of_frequencies(log_evidence)
    draws = np.random.default_rng(seed).dirichlet(alpha, _N_DRAWS)
    exceedance = np.bincount(draws.argmax(axis=1), minlength=k) / _N_DRAWS
    different = _free_energy(log_evidence, alpha, responsibilities)
    shifted = log_evidence - log_evidence.max(axis=1, keepdims=True)
    equal = (np.log(np.exp(shifted).mean(axis=1)) + log_evidence.max(axis=1)).sum()
    p_equal = float(1.0 / (1.0 + np.exp(np.clip(different - equal, -700, 700))))
    protected = exceedance * (1.0 - p_equal) + p_equal / k
    return Selection(alpha / alpha.sum(), exceedance, protected, p_equal)


def _posterior_of_frequencies(log_evidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Dirichlet posterior of the frequencies, and whose model which probably is."""
    k = log_evidence.shape[1]
    alpha = np.ones(k)
    for _ in range(1000):
        weights = log_evidence + digamma(alpha) - digamma(alpha.sum())
        weights = np.exp(weights - weights.max(axis=1, keepdims=True))
        responsibilities = weights / weights.sum(axis=1, keepdims=True)
        updated = 1.0 + responsibilities.sum(axis=0)
        if np.abs(updated - alpha).max() < 1e-8:
            break
        alpha = updated
    return alpha, responsibilities


def _free_energy(
    log_evidence: np.ndarray, alpha: np.ndarray, responsibilities: np.ndarray
) -> float:
    """Return the bound on the evidence that frequencies differ (Rigoux et al., A.20)."""
    k = len(alpha)
    expected = digamma(alpha) - digamma(alpha.sum())
    joint = (responsibilities * (log_evidence + expected)).sum() + gammaln(k)
    entropy = -(responsibilities * np.log(np.maximum(responsibilities, 1e-300))).sum()
    of_frequencies = gammaln(alpha).sum() - gammaln(alpha.sum()) - ((alpha - 1.0) * expected).sum()
    return float(joint + entropy + of_frequencies)
