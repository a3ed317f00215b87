"""What a tracker is: somebody who is told what happens in a run and cannot change it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scilab_rl.results import RunResult


@dataclass(frozen=True)
class RunInfo:
    """What trackers know about a run when it begins.

    Attributes:
        run_dir: The run's directory.
        base_logdir: The directory of all runs.
        env: Environment id.
        algorithm: Algorithm name.
        seed: Seed of the run.
        total_steps: Environment steps of all epochs.
        n_epochs: Most epochs.
        parameters: The whole configuration, flat: ``algorithm.gamma`` to its value.
        project: Project or experiment name for remote trackers, or None.
        entity: Team name for Weights & Biases, or None.
        group: Group of runs, or None.
        tags: Tags for remote trackers.
        notes: The user's ``info`` text.
        resumed_step: Step at which an interrupted run goes on, or None for a new run.
    """

    run_dir: Path
    base_logdir: Path
    env: str
    algorithm: str
    seed: int
    total_steps: int
    n_epochs: int
    parameters: Mapping[str, Any] = field(default_factory=dict)
    project: str | None = None
    entity: str | None = None
    group: str | None = None
    tags: tuple[str, ...] = ()
    notes: str = ""
    resumed_step: int | None = None

    @property
    def name(self) -> str:
        """The name of the run's directory."""
        return self.run_dir.name


class Tracker:
    """Base of all trackers; each method does nothing unless a tracker overrides it."""

    def begin(self, run: RunInfo) -> None:
        """Open what the tracker writes to."""

    def step(self, step: int) -> None:
        """Hear that training has come to this step; called very often."""

    def episode(self, episode: Mapping[str, Any]) -> None:
        """Hear about a finished training episode."""

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""

    def artifact(self, path: Path) -> None:
        """Keep a file that the run has made, such as a video."""

    def end(self, result: RunResult) -> None:
        """Close; called exactly once, also when the run failed."""


@dataclass(frozen=True)
class Held:
    """What a place already knows of a run.

    Attributes:
        steps: The steps at which it has each metric.
        files: The names of the files that it has; None if it takes none.
        is_closed: Whether the rest, such as parameters and how the run ended, is complete too.
    """

    steps: Mapping[str, Set[int]]
    files: Set[str] | None = None
    is_closed: bool = True


class SyncableTracker(Tracker):
    """A tracker that can be told later what it has missed, see `scilab_rl.tracking.sync`."""

    @abstractmethod
    def held(self, run: RunInfo, names: Iterable[str], result: RunResult) -> Held:
        """Return what is there already; changes nothing, and may be called before `begin`.

        Args:
            run: The run.
            names: Of the metrics to look for.
            result: How the run ended.
        """


class TrackerGroup(Tracker):
    """Passes everything on to several trackers, in order.

    Args:
        trackers: The trackers; those that may fail must be wrapped in a mirror.
    """

    def __init__(self, trackers: Iterable[Tracker]) -> None:
        self.trackers = list(trackers)

    def begin(self, run: RunInfo) -> None:
        """Open all trackers."""
        for tracker in self.trackers:
            tracker.begin(run)

    def step(self, step: int) -> None:
        """Pass on a step."""
        for tracker in self.trackers:
            tracker.step(step)

    def episode(self, episode: Mapping[str, Any]) -> None:
        """Pass on an episode."""
        for tracker in self.trackers:
            tracker.episode(episode)

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Pass on an epoch."""
        for tracker in self.trackers:
            tracker.epoch(step, epoch, values)

    def artifact(self, path: Path) -> None:
        """Pass on a file."""
        for tracker in self.trackers:
            tracker.artifact(path)

    def end(self, result: RunResult) -> None:
        """Close all trackers."""
        for tracker in self.trackers:
            tracker.end(result)
