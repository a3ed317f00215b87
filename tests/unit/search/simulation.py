"""Simulated studies with a known best setting and strong noise; no training.

Run as a script for the table: ``python -m tests.unit.search.simulation``.
"""

from __future__ import annotations

import heapq
import random
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from scilab_rl.search.race import RUN, SUGGEST, Entry, RaceRules, next_action, winner


@dataclass(frozen=True)
class Toy:
    """A space of settings whose runs scatter around known means."""

    name: str
    means: tuple[float, ...]
    deviation: float
    rules: RaceRules

    @property
    def best(self) -> int:
        return max(range(len(self.means)), key=self.means.__getitem__)

    def score(self, setting: int, rng: random.Random) -> float:
        return rng.gauss(self.means[setting], self.deviation)


@dataclass(frozen=True)
class Outcome:
    chosen: int
    n_runs: int


# The paper's study: five weights, 64 runs, 3 to 12 repeats; a success rate scatters by 0.2.
PAPER = Toy("5 settings, 64 runs", (0.4, 0.45, 0.5, 0.65, 0.55), 0.2, RaceRules(64, 3, 12))
EASY = Toy("5 settings, one far ahead", (0.2, 0.25, 0.3, 0.8, 0.25), 0.15, RaceRules(64, 3, 12))
WIDE = Toy(
    "20 settings, 120 runs",
    (*(0.3 + 0.02 * (i % 10) for i in range(19)), 0.7),
    0.2,
    RaceRules(120, 3, 12),
)


def simulate_race(toy: Toy, seed: int, n_workers: int = 4) -> Outcome:
    """Run one study as `hyperopt.study` does: free workers ask for work at once."""
    rng = random.Random(seed)
    order = list(range(len(toy.means)))
    rng.shuffle(order)
    scores: dict[int, list[float]] = {}
    running: list[tuple[float, int]] = []
    clock, n_used = 0.0, 0
    while True:
        while len(running) < n_workers:
            decision = next_action(
                _entries(scores, running),
                toy.rules,
                n_used=n_used,
                n_left=len(order) - len(scores),
            )
            if decision.action == SUGGEST:
                setting = order[len(scores)]
            elif decision.action == RUN:
                setting = decision.number
            else:
                break
            scores.setdefault(setting, [])
            n_used += 1
            heapq.heappush(running, (clock + rng.uniform(1, 5), setting))
        if not running:
            break
        clock, setting = heapq.heappop(running)
        scores[setting].append(toy.score(setting, rng))
    chosen = winner(_entries(scores, running), toy.rules)
    assert chosen is not None
    return Outcome(chosen.number, n_used)


def simulate_reference(toy: Toy, seed: int, *, by_mean: bool = False) -> Outcome:
    """Spread the whole budget evenly, then take the setting of the best single run (or mean)."""
    rng = random.Random(seed)
    budget = min(toy.rules.budget, len(toy.means) * toy.rules.max_runs)
    scores = [[] for _ in toy.means]
    for run in range(budget):
        scores[run % len(scores)].append(toy.score(run % len(scores), rng))
    rate = (lambda s: sum(s) / len(s)) if by_mean else max
    return Outcome(max(range(len(scores)), key=lambda i: rate(scores[i])), budget)


def rate_of(outcomes: Sequence[Outcome], toy: Toy) -> float:
    return sum(outcome.chosen == toy.best for outcome in outcomes) / len(outcomes)


def mean_runs(outcomes: Sequence[Outcome]) -> float:
    return sum(outcome.n_runs for outcome in outcomes) / len(outcomes)


def _entries(scores: dict[int, list[float]], running: list[tuple[float, int]]) -> list[Entry]:
    busy = [setting for _, setting in running]
    return [Entry(s, tuple(scores[s]), busy.count(s)) for s in scores]


def main(n_studies: int = 1000) -> None:
    sys.stdout.write("toy | rule | right setting found | runs used\n")
    for toy in (PAPER, EASY, WIDE):
        for rule, simulate in (
            ("race", simulate_race),
            ("best single run", simulate_reference),
            ("best mean", lambda toy, seed: simulate_reference(toy, seed, by_mean=True)),
        ):
            outcomes = [simulate(toy, seed) for seed in range(n_studies)]
            rate, runs = rate_of(outcomes, toy), mean_runs(outcomes)
            sys.stdout.write(f"{toy.name} | {rule} | {rate:.1%} | {runs:.1f}\n")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
