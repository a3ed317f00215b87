"""An experiment: the same seeds and steps for every group; existing runs are reused.

Runs that stopped early on different occasions have been measured on different occasions, and their
last value is one that was high by chance. By default an experiment therefore lets all runs train to
their last epoch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scilab_rl.analysis.comparison import SIGNIFICANT
from scilab_rl.analysis.estimates import detectable_difference, smallest_p
from scilab_rl.analysis.groups import INCOMPLETE, Group, RunRecord, read_records
from scilab_rl.config.compose import compose
from scilab_rl.config.schema import learning_config
from scilab_rl.parallel.grid import outcomes
from scilab_rl.parallel.launchers import open_pool
from scilab_rl.parallel.progress import Progress, time_left
from scilab_rl.parallel.worker import Message, Task
from scilab_rl.results import SOLVED
from scilab_rl.run.checks import check_metrics, complete

_EARLY_STOP = "early_stop_"
_QUIET = "++tracking.console.enabled=false"


@dataclass(frozen=True)
class PlannedGroup:
    """A group of runs that an experiment compares.

    Attributes:
        label: Its name.
        overrides: The command line of all its runs, without the seed.
        config: The part of their configuration that affects learning.
        criterion: The metric to report while they train.
        seeds: The seeds.
        missing: The seeds without a complete run.
        stops_early: Whether the user has chosen when its runs stop early.
    """

    label: str
    overrides: tuple[str, ...]
    config: Mapping[str, str]
    criterion: str
    seeds: tuple[int, ...]
    missing: tuple[int, ...]
    stops_early: bool = False

    @property
    def n_steps(self) -> int:
        """Environment steps of each run."""
        return int(self.config["n_epochs"]) * int(self.config["eval_after_n_steps"])

    def has(self, run: RunRecord) -> bool:
        """Return whether a run belongs to the group.

        When it would have stopped early does not matter for a run that has trained to its end.
        """
        if self.stops_early:
            return run.config == self.config
        if run.status == SOLVED:
            return False
        return _without_early_stop(run.config) == _without_early_stop(self.config)

    def group(self, base: Path) -> Group:
        """Return its runs: the newest complete one of each seed, else the newest."""
        matching = [run for run in read_records(base) if self.has(run)]
        newest = {run.seed: run for run in matching}
        newest |= {run.seed: run for run in matching if run.status not in INCOMPLETE}
        chosen = (newest.get(seed) for seed in self.seeds)
        return Group(
            self.label, " ".join(self.overrides), tuple(run for run in chosen if run is not None)
        )


def plan(
    groups: Mapping[str, Sequence[str]],
    fixed: Sequence[str],
    n_seeds: int,
    first_seed: int,
    base: Path,
) -> list[PlannedGroup]:
    """Compose and check each group, and find its existing runs.

    A run belongs to a group if everything in its configuration that affects learning is equal.

    Raises:
        ConfigError: If a configuration is invalid; nothing has been started.
    """
    seeds = tuple(range(first_seed, first_seed + n_seeds))
    records, planned = read_records(base), []
    for label, overrides in groups.items():
        words = (*overrides, *fixed)
        stops_early = any(word.lstrip("+").startswith(_EARLY_STOP) for word in words)
        cfg = complete(compose([*words, f"base_logdir={base}"]))
        if not stops_early:
            words = (*words, f"{_EARLY_STOP}last_n={cfg.n_epochs + 1}")
            cfg = complete(compose([*words, f"base_logdir={base}"]))
        check_metrics(cfg)
        group = PlannedGroup(
            label, (*words, f"base_logdir={base}"), learning_config(cfg.values()),
            cfg.hyperopt_criterion, seeds, (), stops_early,
        )  # fmt: skip
        complete_seeds = {
            run.seed for run in records if run.status not in INCOMPLETE and group.has(run)
        }
        missing = tuple(seed for seed in seeds if seed not in complete_seeds)
        planned.append(replace(group, missing=missing))
    return planned


def power_of(n_seeds: int, n_groups: int) -> str:
    """Return what a comparison of so many runs can decide at all, known before they train.

    Args:
        n_seeds: Runs of each group.
        n_groups: Groups, the first of which is compared with each of the others.

    >>> power_of(3, 2)
    '3 seeds cannot decide: 3 runs against 3 give p = 0.1 at best. From 4 seeds on they can.'
    """
    level = SIGNIFICANT / (n_groups - 1)  # Holm's correction
    difference = detectable_difference(n_seeds, level)
    best = min(1.0, smallest_p(n_seeds, n_seeds, paired=False) * (n_groups - 1))
    versus = f"{n_seeds} run{'s' * (n_seeds > 1)} against {n_seeds} give p = {best:.2g} at best"
    if difference is None:
        enough = n_seeds
        while smallest_p(enough, enough, paired=False) > level:
            enough += 1
        seeds = f"{n_seeds} seed{'s' * (n_seeds > 1)}"
        return f"{seeds} cannot decide: {versus}. From {enough} seeds on they can."
    return (
        f"{versus}; a difference of {difference:.1f} standard deviations between runs is found in "
        "about 4 of 5 experiments (p < 0.05)."
    )


def train_missing(
    groups: Sequence[PlannedGroup], launcher: Mapping[str, object], n_jobs: int | None, folder: Path
) -> list[str]:
    """Train the missing runs, seed by seed, and return the errors of those that failed."""
    planned = [
        (group, seed, Task((*group.overrides, _QUIET, f"seed={seed}"), group.criterion))
        for seed in groups[0].seeds
        for group in groups
        if seed in group.missing
    ]
    if not planned:
        return []
    failures = []
    with open_pool(launcher, n_jobs, folder) as pool, Progress() as progress:
        state = ExperimentState([(f"{g.label}, seed {s}", g.n_steps) for g, s, _ in planned])
        tasks = [task for _, _, task in planned]

        def on_evaluation(number: int, step: int) -> None:
            state.steps[number] = step
            progress.show(state.lines(progress.seconds))

        for number, message in outcomes(pool, tasks, on_evaluation):
            progress.say(f"{state.runs[number][0]}: {_said(message)}")
            if message.kind != "finished":
                failures.append(str(message.content["error"]))
            state.ended.add(number)
            progress.show(state.lines(progress.seconds))
    return failures


class ExperimentState:
    """How far the runs of an experiment are.

    Args:
        runs: What each is called, and its environment steps.

    Attributes:
        steps: The steps of each run that has been evaluated.
        ended: The runs that have ended.
    """

    def __init__(self, runs: Sequence[tuple[str, int]]) -> None:
        self.runs = runs
        self.steps: dict[int, int] = {}
        self.ended: set[int] = set()

    def lines(self, seconds: float) -> list[str]:
        """Return the state in words.

        Args:
            seconds: Seconds since the beginning.
        """
        done = float(sum(self._done(number) for number in range(len(self.runs))))
        left = sum(steps for _, steps in self.runs) - done
        running = [number for number in sorted(self.steps) if number not in self.ended]
        return [
            f"{len(self.ended)} of {len(self.runs)} runs, {time_left(seconds, done, left)}",
            *(
                f"  {self.runs[n][0]}: {self.steps[n]:,} of {self.runs[n][1]:,} steps"
                for n in running
            ),
        ]

    def _done(self, number: int) -> int:
        return self.runs[number][1] if number in self.ended else self.steps.get(number, 0)


def _said(message: Message) -> str:
    """Return the result of a run in words."""
    if message.kind != "finished":
        return f"FAILED: {message.content['error']}"
    values = message.content["values"]
    return f"{values[-1]:.3g}" if values else "no value"


def _without_early_stop(config: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in config.items() if not key.startswith(_EARLY_STOP)}
