"""The posterior of each participant by adaptive importance sampling.

Near a bound, or after few trials, a posterior is skewed and has long tails, so its curvature at the
mode gives intervals that are too narrow or in the wrong place. Here draws from a mixture of
Student's t distributions are weighted by posterior / mixture. The mixture begins with two: one with
the curvature at the mode, and one as wide as the prior, which bounds the weights (Hesterberg, 1995,
Technometrics 37). Each round adds one with the moments of all weighted draws so far, and weights
them all by the grown mixture (Cornuet et al., 2012, Scandinavian Journal of Statistics 39).

All is on the scale on which the prior is standard normal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

N_DRAWS = 200  # from each part of the mixture
_LEAST_ROUNDS, _MOST_ROUNDS = 2, 8
_FREEDOM = 5.0  # of Student's t
_LEAST_CURVATURE = 0.25  # where the likelihood is flat or bends upwards
ENOUGH = 200.0  # effective draws: the tails of an interval then hold 2.5 ± 1.1 % of the posterior


@dataclass(frozen=True)
class Draws:
    """Weighted draws from the posteriors of all participants.

    Attributes:
        values: Parameters. Shapes: ``(n_participants, n_draws, n_parameters)``.
        weights: Their probabilities, which sum to one. Shapes: ``(n_participants, n_draws)``.
        log_evidence: Log-probability of the choices. Shapes: ``(n_participants,)``.
    """

    values: np.ndarray
    weights: np.ndarray
    log_evidence: np.ndarray

    @property
    def n_effective(self) -> np.ndarray:
        """Independent draws that would be as good. Shapes: ``(n_participants,)``."""
        return 1.0 / (self.weights**2).sum(axis=1)

    def quantile(self, share: float) -> np.ndarray:
        """Return a quantile of each parameter. Shapes: ``(n_participants, n_parameters)``."""
        order = self.values.argsort(axis=1)
        below = np.take_along_axis(self.weights[..., None], order, axis=1).cumsum(axis=1)
        place = (below < share * below[:, -1:]).sum(axis=1, keepdims=True)
        chosen = np.take_along_axis(order, place, axis=1)
        return np.take_along_axis(self.values, chosen, axis=1)[:, 0]


@dataclass(frozen=True)
class _Student:
    """Student's t distributions, one per participant.

    Shapes:
        mean: ``(n, d)``; scale: ``(n, d, d)``, lower triangular.
    """

    mean: np.ndarray
    scale: np.ndarray

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        n, d = self.mean.shape
        normal = rng.standard_normal((n, N_DRAWS, d))
        stretch = np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, (n, N_DRAWS, 1)))
        return self.mean[:, None] + stretch * normal @ self.scale.swapaxes(1, 2)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        d = z.shape[2]
        standard = np.linalg.solve(self.scale, (z - self.mean[:, None]).swapaxes(1, 2))
        volume = np.log(np.diagonal(self.scale, axis1=1, axis2=2)).sum(axis=1)
        constant = gammaln((_FREEDOM + d) / 2) - gammaln(_FREEDOM / 2)
        constant -= 0.5 * d * np.log(_FREEDOM * np.pi)
        tail = np.log1p((standard**2).sum(axis=1) / _FREEDOM)
        return constant - volume[:, None] - 0.5 * (_FREEDOM + d) * tail


def sample(
    log_joint: Callable[[np.ndarray], np.ndarray],
    mode: np.ndarray,
    hessian: np.ndarray,
    rng: np.random.Generator,
) -> Draws:
    """Sample the posteriors of all participants.

    Args:
        log_joint: Log-density of parameters and choices.
        mode: Where it is largest.
        hessian: Of its negative, there.
        rng: The generator.

    Shapes:
        log_joint: ``(n, k, d)`` to ``(n, k)``; mode: ``(n, d)``; hessian: ``(n, d, d)``.
    """
    n, d = mode.shape
    curvature, axes = np.linalg.eigh(hessian)
    axes = axes / np.sqrt(np.maximum(curvature, _LEAST_CURVATURE))[:, None]
    laplace = axes @ axes.swapaxes(1, 2)
    wide = _Student(np.zeros((n, d)), np.broadcast_to(np.eye(d), (n, d, d)))
    mixture = [_Student(mode, np.linalg.cholesky(laplace)), wide]
    parts = [part.draw(rng) for part in mixture]
    joints = [log_joint(z) for z in parts]
    for round_ in range(_MOST_ROUNDS + 1):
        draws = _weighted(parts, joints, mixture)
        enough = (draws.n_effective >= ENOUGH).all()
        if round_ == _MOST_ROUNDS or (round_ >= _LEAST_ROUNDS and enough):
            break
        mixture.append(_fitted(draws, laplace))
        parts.append(mixture[-1].draw(rng))
        joints.append(log_joint(parts[-1]))
    return draws


def _weighted(parts: list[np.ndarray], joints: list[np.ndarray], mixture: list[_Student]) -> Draws:
    z = np.concatenate(parts, axis=1)
    densities = logsumexp([part.log_density(z) for part in mixture], axis=0)
    ratios = np.concatenate(joints, axis=1) - densities + np.log(len(mixture))
    total = logsumexp(ratios, axis=1)
    return Draws(z, np.exp(ratios - total[:, None]), total - np.log(z.shape[1]))


def _fitted(draws: Draws, laplace: np.ndarray) -> _Student:
    """Return a distribution with the moments of the draws; few of them leave much to `laplace`."""
    mean = np.einsum("ns,nsd->nd", draws.weights, draws.values)
    away = draws.values - mean[:, None]
    covariance = np.einsum("ns,nsd,nse->nde", draws.weights, away, away)
    share = (draws.n_effective / (draws.n_effective + mean.shape[1]))[:, None, None]
    return _Student(mean, np.linalg.cholesky(share * covariance + (1.0 - share) * laplace))
