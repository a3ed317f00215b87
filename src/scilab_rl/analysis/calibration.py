"""Does a value predict success? Probabilities from values, and how well they hold.

A value is in units of return, not of probability. The map from one to the other is the best
monotone one: isotonic regression, fitted by pooling adjacent violators (Zadrozny and Elkan, 2002,
"Transforming classifier scores into accurate multiclass probability estimates"; Niculescu-Mizil and
Caruana, 2005, "Predicting good probabilities with supervised learning"). Each episode's probability
comes from a map that was fitted without it and without the others of its goal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scilab_rl.analysis.estimates import Estimate, success_interval

N_FOLDS = 5
N_BINS = 8
_N_SAMPLES = 500


@dataclass(frozen=True)
class ReliabilityBin:
    """Episodes with similar predictions.

    Attributes:
        predicted: Their mean probability.
        observed: Their success rate with Wilson's interval.
        n_episodes: How many.
    """

    predicted: float
    observed: Estimate
    n_episodes: int


@dataclass(frozen=True)
class Calibration:
    """How well values predict success.

    Attributes:
        probabilities: Of each episode, from values of other goals. Shapes: ``(n,)``.
        brier: Mean squared error of the probabilities (Brier, 1950); 0 is best.
        base_brier: That of the success rate of the other goals, for all episodes alike.
        auc: Probability that a successful episode had a higher value than a failed one, ties count
            one half, with an interval from a bootstrap over goals.
        bins: The reliability curve, of bins with about equally many episodes.
    """

    probabilities: np.ndarray
    brier: float
    base_brier: float
    auc: Estimate
    bins: tuple[ReliabilityBin, ...]

    @property
    def skill(self) -> float:
        """Share of the base rate's error that the values remove; below 0 they mislead."""
        return 1 - self.brier / self.base_brier


def calibrate(
    values: np.ndarray, successes: np.ndarray, groups: np.ndarray, *, seed: int = 0
) -> Calibration | None:
    """Compare values of start states with the outcomes of their episodes.

    Args:
        values: Of each episode. Shapes: ``(n,)``.
        successes: Whether it succeeded. Shapes: ``(n,)``.
        groups: Number of its goal, so that no goal is in two folds. Shapes: ``(n,)``.
        seed: Of folds and bootstrap.

    Returns:
        None where all episodes or none succeeded: nothing can be predicted then.
    """
    successes = np.asarray(successes, dtype=float)
    if len(np.unique(successes)) < 2 or len(np.unique(groups)) < N_FOLDS:
        return None
    rng = np.random.default_rng(seed)
    names, group = np.unique(groups, return_inverse=True)
    folds = (rng.permutation(len(names)) % N_FOLDS)[group]
    probabilities, base = np.empty(len(values)), np.empty(len(values))
    for fold in range(N_FOLDS):
        here = folds == fold
        probabilities[here] = isotonic(values[~here], successes[~here], values[here])
        base[here] = successes[~here].mean()
    return Calibration(
        probabilities,
        float(np.mean((probabilities - successes) ** 2)),
        float(np.mean((base - successes) ** 2)),
        _auc_interval(values, successes, group, rng),
        tuple(_bins(probabilities, successes)),
    )


def isotonic(values: np.ndarray, successes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the best rising map from values to success, at other values.

    Between the fitted values it is interpolated, and beyond them constant.

    Shapes:
        values, successes: ``(n,)``; at, result: ``(m,)``.

    >>> values, successes = np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0])
    >>> isotonic(values, successes, np.array([0.5, 3.0])).tolist()
    [0.25, 0.5]
    """
    from scipy import optimize  # heavy

    points, place = np.unique(values, return_inverse=True)
    weights = np.bincount(place)
    means = np.bincount(place, weights=successes) / weights
    fitted = optimize.isotonic_regression(means, weights=weights).x
    return np.interp(at, points, fitted)


def area_under_roc(values: np.ndarray, successes: np.ndarray) -> float:
    """Return how often a success has the higher value, from ranks (Mann and Whitney, 1947).

    >>> area_under_roc(np.array([1.0, 2.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0, 1.0]))
    0.875
    """
    from scipy import stats  # heavy

    won = np.asarray(successes) > 0.5
    n_won, n_lost = int(won.sum()), int((~won).sum())
    ranks = stats.rankdata(values)
    return float((ranks[won].sum() - n_won * (n_won + 1) / 2) / (n_won * n_lost))


def _auc_interval(
    values: np.ndarray, successes: np.ndarray, group: np.ndarray, rng: np.random.Generator
) -> Estimate:
    members = [np.flatnonzero(group == index) for index in range(group.max() + 1)]
    samples = []
    for _ in range(_N_SAMPLES):
        chosen = np.concatenate(
            [members[index] for index in rng.integers(len(members), size=len(members))]
        )
        if 0 < successes[chosen].mean() < 1:
            samples.append(area_under_roc(values[chosen], successes[chosen]))
    low, high = np.quantile(samples, [0.025, 0.975])
    return Estimate(area_under_roc(values, successes), float(low), float(high))


def _bins(probabilities: np.ndarray, successes: np.ndarray) -> list[ReliabilityBin]:
    order = np.argsort(probabilities, kind="stable")
    bins = []
    for part in np.array_split(order, N_BINS):
        if len(part):
            observed = success_interval(int(successes[part].sum()), len(part))
            bins.append(ReliabilityBin(float(probabilities[part].mean()), observed, len(part)))
    return bins
