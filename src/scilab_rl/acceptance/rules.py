"""Acceptance rules: decide from one number per training run whether a target is reached.

Runs with different seeds are the independent units: the evaluation episodes of one policy tell much
about that policy and nothing about the next seed. Each rule therefore gets the mean over the
evaluation episodes of each run, in the order of the seeds, and decides after each run whether more
are needed. Rules are pure functions of numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

OPEN, PASS, FAIL, INCONCLUSIVE = "open", "pass", "fail", "inconclusive"
_CODES = (OPEN, PASS, FAIL, INCONCLUSIVE)
_N_PATHS = 100_000  # the simulated boundary is exact to about 0.0007 in alpha


@dataclass(frozen=True)
class Verdict:
    """The decision of a rule about the runs so far.

    Attributes:
        outcome: ``open`` (train another run), ``pass``, ``fail`` or ``inconclusive``.
        n_runs: Runs that the decision used.
        mean: Mean over these runs.
        low: Lower end of the interval of the mean, valid at any stopping time; None for a rule
            without one.
        high: Its upper end.
    """

    outcome: str
    n_runs: int
    mean: float
    low: float | None = None
    high: float | None = None


class Rule(Protocol):
    """Decides from the runs of one test, or of many simulated tests at once.

    Attributes:
        min_runs: The fewest runs that can decide.
        max_runs: The budget.
    """

    @property
    def min_runs(self) -> int: ...  # noqa: D102

    @property
    def max_runs(self) -> int: ...  # noqa: D102

    def outcomes(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the outcome of each test and how many runs it used.

        Args:
            runs: One row per test, one column per run in the order of the seeds.

        Shapes:
            runs: ``(n_tests, n_runs)``; both results: ``(n_tests,)``, the first of indices of
            ``(open, pass, fail, inconclusive)``.
        """

    def interval(self, values: Sequence[float]) -> tuple[float | None, float | None]:
        """Return an interval of the mean, or None twice."""


def decide(rule: Rule, values: Sequence[float]) -> Verdict:
    """Return the verdict of a rule about the runs of a test.

    Args:
        rule: The rule.
        values: One number per run, in the order of the seeds, without gaps.
    """
    if not len(values):
        return Verdict(OPEN, 0, math.nan)
    codes, n_used = rule.outcomes(np.asarray(values, dtype=np.float64)[None])
    used = list(values)[: int(n_used[0])]
    return Verdict(
        _CODES[int(codes[0])], len(used), math.fsum(used) / len(used), *rule.interval(used)
    )


@dataclass(frozen=True)
class SequentialTest:
    """A group-sequential t-test of two hypotheses about the mean over runs.

    It passes when "the mean is at most ``required - margin``" is rejected, and fails when "the mean
    is at least ``required``" is; each of the two is rejected wrongly with probability ``alpha`` at
    most, however often one looks. That holds for run results that are about normal, whatever their
    spread; ``benchmarks/acceptance_rules.py`` simulates others. Within the margin both answers are
    right. The boundary spends alpha in proportion to the runs (Kim and DeMets, 1987, Biometrika 74;
    Jennison and Turnbull, 1999, chapters 7 and 11), and is found by simulating t statistics. The
    spread between runs is estimated, and never taken to be smaller than half the margin: three runs
    that happen to agree prove less than they seem to.

    Args:
        required: The target of the mean.
        margin: A mean this far below the target is certainly too low; above 0.
        alpha: Probability of each of the two errors.
        min_runs: Runs before the first decision, at least 2.
        max_runs: The budget; afterwards the answer is ``inconclusive``.
        limits: The range of possible means, for the interval.
    """

    required: float
    margin: float
    alpha: float = 0.05
    min_runs: int = 3
    max_runs: int = 14
    limits: tuple[float, float] = (-math.inf, math.inf)

    def outcomes(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the outcome of each test and how many runs it used; see `Rule`."""
        counts, means, spreads = _running_moments(runs[:, : self.max_runs])
        errors = np.maximum(spreads, self.margin / 2) / np.sqrt(counts)
        bounds = np.full(len(counts), np.inf)
        first = self.min_runs - 1
        limits = boundary(self.alpha, self.min_runs, self.max_runs)
        bounds[first:] = limits[: max(len(counts) - first, 0)]
        with np.errstate(invalid="ignore"):  # nothing is decided where the bound is infinite
            above = (means - (self.required - self.margin)) / errors >= bounds
            below = (self.required - means) / errors >= bounds
        upper = means >= self.required - self.margin / 2  # both: the nearer one
        return _first_decision(above & (upper | ~below), below & (~upper | ~above), self.max_runs)

    def interval(self, values: Sequence[float]) -> tuple[float | None, float | None]:
        """Return the repeated confidence interval of the mean (Jennison and Turnbull, chapter 9).

        It contains the mean with probability ``1 - 2 alpha`` at all moments together.
        """
        n = len(values)
        if n < max(self.min_runs, 2):
            return None, None
        spread = max(float(np.std(values, ddof=1)), self.margin / 2)
        limit = boundary(self.alpha, self.min_runs, self.max_runs)[n - self.min_runs]
        half = float(limit) * spread / math.sqrt(n)
        low, high = np.clip([np.mean(values) - half, np.mean(values) + half], *self.limits)
        return float(low), float(high)


@dataclass(frozen=True)
class ReferenceRule:
    """The reference's rule: ``succ_runs`` of ``total_runs`` runs reach the value.

    Args:
        required: The value that a run has to reach.
        succ_runs: How many runs have to reach it.
        max_runs: Out of how many, ``total_runs``.
    """

    required: float
    succ_runs: int = 2
    max_runs: int = 3

    @property
    def min_runs(self) -> int:
        """The fewest runs after which it can pass or fail."""
        return min(self.succ_runs, self.max_runs - self.succ_runs + 1)

    def outcomes(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the outcome of each test and how many runs it used; see `Rule`."""
        reached = (runs[:, : self.max_runs] >= self.required).cumsum(axis=1)
        counts = np.arange(1, reached.shape[1] + 1)
        hopeless = self.max_runs - counts + reached < self.succ_runs
        return _first_decision(reached >= self.succ_runs, hopeless, self.max_runs)

    def interval(self, values: Sequence[float]) -> tuple[float | None, float | None]:
        """Return None twice: this rule has no interval."""
        return None, None


@functools.lru_cache(maxsize=32)
def boundary(alpha: float, min_runs: int, max_runs: int) -> np.ndarray:
    """Return the bound of the t statistic after each number of runs from ``min_runs`` on.

    Of all paths of the statistic under its hypothesis, a share of ``alpha n / max_runs`` has
    crossed the boundary after n runs.

    Shapes:
        result: ``(max_runs - min_runs + 1,)``.
    """
    draws = np.random.default_rng(20260101).standard_normal((_N_PATHS, max_runs))
    counts, means, spreads = _running_moments(draws)
    inside, limits, crossed = np.ones(_N_PATHS, dtype=bool), [], 0
    for n in range(min_runs, max_runs + 1):
        statistic = means[:, n - 1] * np.sqrt(counts[n - 1]) / spreads[:, n - 1]
        n_crossing = round(alpha * n / max_runs * _N_PATHS) - crossed
        remaining = np.sort(statistic[inside])
        limits.append(float(remaining[-max(n_crossing, 1)]))
        inside &= statistic < limits[-1]
        crossed = _N_PATHS - int(inside.sum())
    return np.array(limits)


def _running_moments(runs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of runs, and mean and standard deviation over the first so many.

    Shapes:
        runs: ``(n_tests, n_runs)``; results: ``(n_runs,)`` and twice ``(n_tests, n_runs)``.
    """
    counts = np.arange(1, runs.shape[1] + 1)
    shift = runs[:, :1]  # so that the difference of squares loses nothing to rounding
    centered = runs - shift
    sums, squares = centered.cumsum(axis=1), (centered**2).cumsum(axis=1)
    variances = (squares - sums**2 / counts) / np.maximum(counts - 1, 1)
    return counts, sums / counts + shift, np.sqrt(np.maximum(variances, 0.0))


def _first_decision(
    passes: np.ndarray, fails: np.ndarray, max_runs: int
) -> tuple[np.ndarray, np.ndarray]:
    decided = passes | fails
    n_runs = decided.shape[1]
    first = np.where(decided.any(axis=1), decided.argmax(axis=1), n_runs - 1)
    rows = np.arange(len(decided))
    codes = np.full(len(decided), _CODES.index(INCONCLUSIVE if n_runs >= max_runs else OPEN))
    codes[passes[rows, first]] = _CODES.index(PASS)
    codes[fails[rows, first]] = _CODES.index(FAIL)
    return codes, first + 1
