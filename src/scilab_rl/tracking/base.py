"""The interface of trackers, which are notified of a run's events and cannot change it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from pathlib import Path

from scilab_rl.config.schema import RunConfig
from scilab_rl.redaction import redact
from scilab_rl.results import RunResult


@dataclass(frozen=True)
class TrackedRun:
    """A run as its trackers know it when it begins.

    Attributes:
        cfg: The configuration of the run.
        run_dir: The run's directory.
        resumed_step: Step at which an interrupted run continues, or None for a new run.
    """

    cfg: RunConfig
    run_dir: Path
    resumed_step: int | None = None

    @property
    def name(self) -> str:
        """The name of the run's directory."""
        return self.run_dir.name

    @property
    def base_logdir(self) -> Path:
        """The directory of all runs."""
        return Path(self.cfg.base_logdir)

    @property
    def project(self) -> str:
        """Project or experiment name for remote trackers."""
        return self.cfg.project_name or "scilab-rl"

    @property
    def tags(self) -> list[str]:
        """Tags for remote trackers."""
        return [str(tag) for tag in self.cfg.tags or ()]

    @property
    def parameters(self) -> dict[str, object]:
        """The whole configuration without secrets: ``algorithm.gamma`` to its value."""
        return {
            name: redact(value) if isinstance(value, str) else value
            for name, value in self.cfg.flat().items()
        }


class Tracker:
    """Base of all trackers; each method does nothing unless a tracker overrides it."""

    def begin(self, run: TrackedRun) -> None:
        """Open what the tracker writes to."""

    def step(self, step: int) -> None:
        """Hear that training has come to this step; called very often."""

    def episode(self, episode: Mapping[str, float]) -> None:
        """Hear about a finished training episode."""

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""

    def artifact(self, path: Path) -> None:
        """Keep a file that the run has made, such as a video."""

    def end(self, result: RunResult) -> None:
        """Close; called exactly once, also when the run failed."""


@dataclass(frozen=True)
class RemoteState:
    """The part of a run that a tracker has already stored.

    Attributes:
        steps: The steps at which it has each metric.
        files: The names of the files that it has; None if it takes none.
        is_closed: Whether the rest, such as parameters and how the run ended, is complete too.
    """

    steps: Mapping[str, Set[int]]
    files: Set[str] | None = None
    is_closed: bool = True


class SyncableTracker(Tracker):
    """A tracker to which missed events can be sent later, see `scilab_rl.tracking.sync`."""

    @abstractmethod
    def remote_state(self, run: TrackedRun, names: Iterable[str], result: RunResult) -> RemoteState:
        """Return what is there already; changes nothing, and may be called before `begin`.

        Args:
            run: The run.
            names: Of the metrics to look for.
            result: How the run ended.
        """


class TrackerGroup(Tracker):
    """Passes everything on to several trackers, in order.

    Args:
        trackers: The trackers; wrap those that may fail in a `BackgroundTracker`.
    """

    def __init__(self, trackers: Iterable[Tracker]) -> None:
        self.trackers = list(trackers)

    def begin(self, run: TrackedRun) -> None:
        """Open all trackers."""
        for tracker in self.trackers:
            tracker.begin(run)

    def step(self, step: int) -> None:
        """Pass on a step."""
        for tracker in self.trackers:
            tracker.step(step)

    def episode(self, episode: Mapping[str, float]) -> None:
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
