"""Which configuration gets the next run, and which has won: pure functions of the scores so far.

Each configuration first gets ``min_runs`` runs. Half of the budget goes to new configurations, or
more where that suffices for all of the space. The rest is a race between those that may still be
best: successive halving (Jamieson and Talwalkar, 2016, arXiv 1502.07943), asynchronous as in ASHA
(Li et al., 2020, arXiv 1810.05934), with repeats in place of epochs as its resource. A rung has
twice the repeats of the one below; a configuration climbs when its mean is in the upper half of its
rung *and* its confidence interval still reaches that of the leader. When only one configuration may
still be best, none earns further repeats.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

RUN, SUGGEST, WAIT, DONE = "run", "suggest", "wait", "done"


@dataclass(frozen=True)
class RaceRules:
    """The budget of a study.

    Attributes:
        budget: Runs of the whole study.
        min_runs: Runs of each configuration.
        max_runs: Most runs of one configuration.
        maximize: Whether a larger score is better.
        racing: Whether configurations earn more than ``min_runs``; not with several objectives.
        exploration: Share of the budget for trying new configurations.
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
        """Return the numbers of repeats at which a configuration has to earn more."""
        rungs = [self.min_runs]
        while rungs[-1] * 2 < self.max_runs:
            rungs.append(rungs[-1] * 2)
        return rungs if rungs[-1] == self.max_runs else [*rungs, self.max_runs]


@dataclass(frozen=True)
class Entry:
    """One configuration in the race.

    Attributes:
        number: Its trial number.
        scores: The scores of its finished runs.
        n_running: Runs that are going on.
        eliminated: Whether it failed or was pruned, so that it can neither run nor win.
    """

    number: int
    scores: tuple[float, ...] = ()
    n_running: int = 0
    eliminated: bool = False

    @property
    def n_runs(self) -> int:
        """Finished and running ones."""
        return len(self.scores) + self.n_running

    @functools.cached_property
    def mean(self) -> float:
        """The mean score."""
        return math.fsum(self.scores) / len(self.scores)


@dataclass(frozen=True)
class Decision:
    """The next task of a free worker.

    Attributes:
        action: RUN a repeat of a configuration, SUGGEST a new one, WAIT for running ones, or DONE.
        number: The configuration to run.
    """

    action: str
    number: int = -1


def next_action(
    entries: Sequence[Entry],
    rules: RaceRules,
    *,
    n_used: int,
    n_left: float,
    try_all: bool = False,
) -> Decision:
    """Return the next task of a free worker.

    Args:
        entries: All configurations so far.
        rules: What may be spent.
        n_used: Runs started so far, failed and pruned ones included.
        n_left: How many configurations of the space have not been tried; infinite for most.
        try_all: Whether all configurations come before the race.
    """
    running = any(entry.n_running for entry in entries)
    pause = Decision(WAIT if running else DONE)
    if n_used >= rules.budget:
        return pause
    rungs = rules.rungs()
    for entry in entries:
        on_its_way = entry.n_runs < rules.max_runs and entry.n_runs not in rungs
        if not entry.eliminated and on_its_way:
            return Decision(RUN, entry.number)
    may_suggest = n_left > 0 and (rules.budget - n_used >= rules.min_runs or not entries)
    exploring = try_all or n_used < rules.exploration * rules.budget or not rules.racing
    if may_suggest and exploring:
        return Decision(SUGGEST)
    climber = _climber(entries, rules, only_upper_half=may_suggest or running)
    if climber is not None:
        return Decision(RUN, climber.number)
    return Decision(SUGGEST) if may_suggest else pause


def _climber(entries: Sequence[Entry], rules: RaceRules, *, only_upper_half: bool) -> Entry | None:
    """Return the configuration that has earned further repeats, if any."""
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
    """Return the configurations whose interval reaches that of the leader, the leader included.

    The leader is the configuration with the best lower end of its interval.
    """
    ranked = [e for e in entries if not e.eliminated and len(e.scores) >= rules.min_runs]
    if not ranked:
        return []
    spread = spread_of(ranked, rules)
    means = [_signed(e.mean, rules) for e in ranked]
    widths = [half_width(e, spread) for e in ranked]
    best_low = max(mean - width for mean, width in zip(means, widths, strict=True))
    return [
        entry
        for entry, mean, width in zip(ranked, means, widths, strict=True)
        if mean + width >= best_low
    ]


def winner(entries: Iterable[Entry], rules: RaceRules) -> Entry | None:
    """Return the configuration with the best pessimistic end of its interval, or None.

    The interval is wide for few repeats, so that a lucky configuration does not beat a proven one.
    """
    ranked = [e for e in entries if not e.eliminated and e.scores]
    complete = [e for e in ranked if len(e.scores) >= rules.min_runs]
    ranked = complete or ranked
    if not ranked:
        return None
    spread = spread_of(ranked, rules)
    return max(
        ranked,
        key=lambda e: (
            _signed(e.mean, rules) - half_width(e, spread),
            _signed(e.mean, rules),  # decides when there are single runs only
            -e.number,
        ),
    )


def spread_of(peers: Sequence[Entry], rules: RaceRules) -> float:
    """Return half the width of the confidence interval of a single run's score.

    With the standard deviation pooled over all configurations: that of three runs alone says
    little.
    """
    degrees = sum(len(peer.scores) - 1 for peer in peers)
    if degrees < 1:
        return math.inf
    return student_quantile(0.5 + rules.confidence / 2, degrees) * pooled_deviation(peers)


def half_width(entry: Entry, spread: float) -> float:
    """Return half the width of the confidence interval of a configuration's mean.

    Args:
        entry: The configuration.
        spread: Of all configurations, by `spread_of`.
    """
    return spread / math.sqrt(len(entry.scores))


def pooled_deviation(entries: Iterable[Entry]) -> float:
    """Return the standard deviation of a run around the mean of its configuration.

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

    >>> round(student_quantile(0.95, 10), 4)
    1.8125
    """
    from scipy.special import stdtrit  # heavy

    return float(stdtrit(degrees, probability))


def _in_upper_half(entry: Entry, entries: Iterable[Entry], rules: RaceRules) -> bool:
    """Return whether a configuration is in the upper half of those that have as many repeats."""
    rung = [e for e in entries if not e.eliminated and len(e.scores) >= len(entry.scores)]
    better = sum(_signed(e.mean, rules) > _signed(entry.mean, rules) for e in rung)
    return better < math.ceil(len(rung) / 2)


def _signed(value: float, rules: RaceRules) -> float:
    return value if rules.maximize else -value
