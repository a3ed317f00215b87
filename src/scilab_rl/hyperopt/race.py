"""Which setting deserves the next run, and which one has won: pure functions of the scores so far.

Each setting first gets ``min_runs`` runs. Half of the budget goes to new settings, or more where
that suffices for all settings of the space. The rest is a race between those that may still be
best: successive halving (Jamieson and Talwalkar, 2016, arXiv 1502.07943), asynchronous as in ASHA
(Li et al., 2020, arXiv 1810.05934), with repeats in place of epochs as its resource. A rung has
twice the repeats of the one below; a setting climbs when its mean is in the upper half of its rung
*and* its confidence interval still reaches that of the leader. When only one setting may still be
best, nobody earns further repeats.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

RUN, ASK, WAIT, DONE = "run", "ask", "wait", "done"


@dataclass(frozen=True)
class RaceRules:
    """What a study may spend.

    Attributes:
        budget: Runs of the whole study.
        min_runs: Runs of each setting.
        max_runs: Most runs of one setting.
        maximize: Whether a larger score is better.
        racing: Whether settings earn more than ``min_runs``; not with several objectives.
        exploration: Share of the budget for trying new settings.
        confidence: Of the intervals that decide who may still be best.
    """

    budget: int
    min_runs: int
    max_runs: int
    maximize: bool = True
    racing: bool = True
    exploration: float = 0.5
    confidence: float = 0.9

    def rungs(self) -> list[int]:
        """Return the numbers of repeats at which a setting has to earn more."""
        rungs = [self.min_runs]
        while rungs[-1] * 2 < self.max_runs:
            rungs.append(rungs[-1] * 2)
        return rungs if rungs[-1] == self.max_runs else [*rungs, self.max_runs]


@dataclass(frozen=True)
class Entry:
    """One setting in the race.

    Attributes:
        number: Its trial number.
        scores: The scores of its finished runs.
        n_running: Runs that are going on.
        out: Whether it failed or was pruned, so that it can neither run nor win.
    """

    number: int
    scores: tuple[float, ...] = ()
    n_running: int = 0
    out: bool = False

    @property
    def n_runs(self) -> int:
        """Finished and running ones."""
        return len(self.scores) + self.n_running

    @property
    def mean(self) -> float:
        """The mean score."""
        return math.fsum(self.scores) / len(self.scores)


@dataclass(frozen=True)
class Decision:
    """What a free worker shall do.

    Attributes:
        action: RUN a repeat of a setting, ASK the sampler for a new setting, WAIT for running ones,
            or DONE.
        number: The setting to run.
    """

    action: str
    number: int = -1


def decide(
    entries: Sequence[Entry],
    rules: RaceRules,
    *,
    n_used: int,
    n_left: float,
    try_all: bool = False,
) -> Decision:
    """Return what a free worker shall do next.

    Args:
        entries: All settings so far.
        rules: What may be spent.
        n_used: Runs started so far, failed and pruned ones included.
        n_left: How many settings of the space have not been tried; infinite for most.
        try_all: Whether all settings come before the race.
    """
    running = any(entry.n_running for entry in entries)
    pause = Decision(WAIT if running else DONE)
    if n_used >= rules.budget:
        return pause
    rungs = rules.rungs()
    for entry in entries:
        on_its_way = entry.n_runs < rules.max_runs and entry.n_runs not in rungs
        if not entry.out and on_its_way:
            return Decision(RUN, entry.number)
    may_ask = n_left > 0 and (rules.budget - n_used >= rules.min_runs or not entries)
    exploring = try_all or n_used < rules.exploration * rules.budget or not rules.racing
    if may_ask and exploring:
        return Decision(ASK)
    climber = _climber(entries, rules, only_upper_half=may_ask or running)
    if climber is not None:
        return Decision(RUN, climber.number)
    return Decision(ASK) if may_ask else pause


def _climber(entries: Sequence[Entry], rules: RaceRules, *, only_upper_half: bool) -> Entry | None:
    """Return the setting that has earned further repeats, if any."""
    contenders = may_still_be_best(entries, rules)
    if len(contenders) < 2 or not rules.racing:
        return None
    ready = [e for e in contenders if not e.n_running and e.n_runs < rules.max_runs]
    ready.sort(key=lambda entry: _signed(entry.mean, rules), reverse=True)
    for entry in ready:
        if _in_upper_half(entry, entries, rules):
            return entry
    return ready[0] if ready and not only_upper_half else None


def may_still_be_best(entries: Iterable[Entry], rules: RaceRules) -> list[Entry]:
    """Return the settings whose interval reaches that of the leader, the leader included.

    The leader is the setting with the best lower end of its interval.
    """
    ranked = [e for e in entries if not e.out and len(e.scores) >= rules.min_runs]
    if not ranked:
        return []
    spread = pooled_deviation(ranked)
    lows = [_signed(e.mean, rules) - half_width(e, ranked, rules, spread) for e in ranked]
    highs = [_signed(e.mean, rules) + half_width(e, ranked, rules, spread) for e in ranked]
    return [entry for entry, high in zip(ranked, highs, strict=True) if high >= max(lows)]


def winner(entries: Iterable[Entry], rules: RaceRules) -> Entry | None:
    """Return the setting with the best pessimistic end of its interval, or None.

    The interval is wide for few repeats, so that one lucky setting does not beat a proven one.
    """
    ranked = [e for e in entries if not e.out and e.scores]
    complete = [e for e in ranked if len(e.scores) >= rules.min_runs]
    ranked = complete or ranked
    if not ranked:
        return None
    spread = pooled_deviation(ranked)
    return max(
        ranked,
        key=lambda e: (
            _signed(e.mean, rules) - half_width(e, ranked, rules, spread),
            _signed(e.mean, rules),  # decides when there are single runs only
            -e.number,
        ),
    )


def half_width(
    entry: Entry, peers: Sequence[Entry], rules: RaceRules, deviation: float | None = None
) -> float:
    """Return half the width of the confidence interval of a setting's mean.

    With the standard deviation pooled over all settings: that of three runs alone says little.
    """
    degrees = sum(len(peer.scores) - 1 for peer in peers)
    if degrees < 1:
        return math.inf
    deviation = pooled_deviation(peers) if deviation is None else deviation
    quantile = student_quantile(0.5 + rules.confidence / 2, degrees)
    return quantile * deviation / math.sqrt(len(entry.scores))


def pooled_deviation(entries: Iterable[Entry]) -> float:
    """Return the standard deviation of a run around the mean of its setting.

    >>> pooled_deviation([Entry(0, (0.0, 2.0)), Entry(1, (5.0, 7.0))])
    1.4142135623730951
    """
    squares, degrees = 0.0, 0
    for entry in entries:
        squares += math.fsum((score - entry.mean) ** 2 for score in entry.scores)
        degrees += len(entry.scores) - 1
    return math.sqrt(squares / degrees) if degrees > 0 else 0.0


def student_quantile(probability: float, degrees: int) -> float:
    """Return the quantile of Student's t distribution.

    Exact for one and two degrees of freedom; else the expansion 26.7.5 of Abramowitz and Stegun
    (1964), with an error below 1 % for probabilities up to 0.975.

    >>> round(student_quantile(0.95, 10), 2)
    1.81
    """
    if degrees == 1:
        return math.tan(math.pi * (probability - 0.5))
    if degrees == 2:
        return (2 * probability - 1) / math.sqrt(2 * probability * (1 - probability))
    x, n = NormalDist().inv_cdf(probability), degrees
    return (
        x
        + (x**3 + x) / (4 * n)
        + (5 * x**5 + 16 * x**3 + 3 * x) / (96 * n**2)
        + (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / (384 * n**3)
    )


def _in_upper_half(entry: Entry, entries: Iterable[Entry], rules: RaceRules) -> bool:
    """Tell whether a setting is in the upper half of those that have as many repeats."""
    rung = [e for e in entries if not e.out and len(e.scores) >= len(entry.scores)]
    better = sum(_signed(e.mean, rules) > _signed(entry.mean, rules) for e in rung)
    return better < math.ceil(len(rung) / 2)


def _signed(value: float, rules: RaceRules) -> float:
    return value if rules.maximize else -value
