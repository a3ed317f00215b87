"""When is a success rate good enough? Rules that decide from one number per training run.

Runs with different seeds are the independent units: the episodes that one policy is evaluated with
say much about that policy and nothing about the next seed. So each rule gets the mean over the
evaluation episodes of each run, in the order of their seeds, and tells after each run whether to go
on. Pure functions of numbers; who trains the runs is not their business.
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
_N_BETS = 24


@dataclass(frozen=True)
class Verdict:
    """What a rule says about the runs so far.

    Attributes:
        outcome: ``open`` (train another run), ``pass``, ``fail`` or ``inconclusive``.
        n_runs: Runs that the decision used.
        mean: Mean over these runs.
        low: Lower end of the interval of the mean that holds at any moment of stopping; None for a
            rule that has none.
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
        min_runs: So many runs are needed in any case.
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
    """Return what a rule says about the runs of a test.

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
    spread, and the simulation in ``benchmarks/gates.py`` shows what happens for others. In between
    lies the margin, where both answers are right. The boundary spends alpha in proportion to the
    runs (Kim and DeMets, 1987, Biometrika 74; Jennison and Turnbull, 1999, chapters 7 and 11), and
    is found by simulating t statistics. The spread between runs is estimated, and never taken to be
    smaller than half the margin: three runs that happen to agree prove less than they seem to.

    Args:
        required: The mean that is asked for.
        margin: How far below it is certainly too little; above 0.
        alpha: Probability of each of the two mistakes.
        min_runs: Runs before the first decision, at least 2.
        max_runs: The budget; afterwards the answer is ``inconclusive``.
        limits: What a mean can be, for its interval.
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
        needed = boundary(self.alpha, self.min_runs, self.max_runs)
        bounds[first:] = needed[: max(len(counts) - first, 0)]
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
class BoundedTest:
    """The same two hypotheses without any assumption on how runs differ, but for more runs.

    Each run's result is a bet against a hypothesis: with results in [0, 1] the capital
    ``prod(1 + lambda (x_i - m))`` has no drift upwards when the mean is at most m, so that it ever
    reaches ``1 / alpha`` with probability alpha at most (Ville's inequality; Waudby-Smith and
    Ramdas, 2024, JRSS B 86, arXiv 2010.09686). The capital is the mean over a grid of lambdas.

    Args:
        required: The success rate that is asked for, above ``margin`` and below 1.
        margin: How far below it is certainly too little.
        alpha: Probability of each of the two mistakes.
        max_runs: The budget.
    """

    required: float
    margin: float
    alpha: float = 0.05
    max_runs: int = 40

    @property
    def min_runs(self) -> int:
        """Return after how many perfect runs the larger of the two bets can be won."""
        best = max(-math.log(self.required - self.margin), -math.log(1 - self.required))
        return math.ceil(-math.log(self.alpha) / best)

    def outcomes(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the outcome of each test and how many runs it used; see `Rule`."""
        runs = runs[:, : self.max_runs]
        above = _capital(runs, self.required - self.margin) >= 1 / self.alpha
        below = _capital(1 - runs, 1 - self.required) >= 1 / self.alpha
        return _first_decision(above, below & ~above, self.max_runs)

    def interval(self, values: Sequence[float]) -> tuple[float | None, float | None]:
        """Return the means that no bet has refuted, on a grid of 0.005."""
        runs = np.asarray(values, dtype=np.float64)[None]
        grid = np.linspace(0.005, 0.995, 199)
        low = [m for m in grid if _capital(runs, m).max() >= 1 / self.alpha]
        high = [m for m in grid if _capital(1 - runs, 1 - m).max() >= 1 / self.alpha]
        return float(max(low, default=0.0)), float(min(high, default=1.0))


@dataclass(frozen=True)
class ReferenceRule:
    """The reference's rule: ``succ_runs`` of ``total_runs`` runs reach the value.

    Args:
        required: The value that a run has to reach.
        succ_runs: So many runs have to.
        max_runs: Of so many, ``total_runs``.
    """

    required: float
    succ_runs: int = 2
    max_runs: int = 3

    @property
    def min_runs(self) -> int:
        """Return after how many runs it can pass or fail."""
        return min(self.succ_runs, self.max_runs - self.succ_runs + 1)

    def outcomes(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the outcome of each test and how many runs it used; see `Rule`."""
        reached = (runs[:, : self.max_runs] >= self.required).cumsum(axis=1)
        counts = np.arange(1, reached.shape[1] + 1)
        hopeless = self.max_runs - counts + reached < self.succ_runs
        return _first_decision(reached >= self.succ_runs, hopeless, self.max_runs)

    def interval(self, values: Sequence[float]) -> tuple[float | None, float | None]:
        """Return None twice: this rule knows no uncertainty."""
        return None, None


@functools.lru_cache(maxsize=32)
def boundary(alpha: float, min_runs: int, max_runs: int) -> np.ndarray:
    """Return what the t statistic has to reach after each number of runs from ``min_runs`` on.

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
        wanted = round(alpha * n / max_runs * _N_PATHS) - crossed
        remaining = np.sort(statistic[inside])
        limits.append(float(remaining[-max(wanted, 1)]))
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
    centred = runs - shift
    sums, squares = centred.cumsum(axis=1), (centred**2).cumsum(axis=1)
    variances = (squares - sums**2 / counts) / np.maximum(counts - 1, 1)
    return counts, sums / counts + shift, np.sqrt(np.maximum(variances, 0.0))


def _capital(runs: np.ndarray, mean: float) -> np.ndarray:
    """Return the capital of betting that the mean is above this one, after each run."""
    bets = np.linspace(0, 1, _N_BETS + 1)[1:] / mean * 0.999  # never all at once
    growth = np.log1p(bets[:, None, None] * (runs[None] - mean)).cumsum(axis=2)
    return np.exp(growth).mean(axis=0)


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
