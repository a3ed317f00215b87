"""The duties of a run besides learning: one small callback each."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.metrics.criteria import is_better, should_stop_early
from scilab_rl.metrics.store import MetricStore
from scilab_rl.results import PRUNED, SOLVED
from scilab_rl.tracking.base import Tracker
from scilab_rl.training import resume
from scilab_rl.training.interruption import StopRequest, TrainingInterrupted
from scilab_rl.training.policy import BEST, KEPT, save_policy
from scilab_rl.training.snapshot import Snapshot
from scilab_rl.training.state import RunState

if TYPE_CHECKING:
    from scilab_rl.training.loop import Trainer

_log = logging.getLogger(__name__)


class RunCallback(BaseCallback):
    """A callback of Stable-Baselines3 that is also notified of a run's beginning, epochs and end.

    Each method does nothing by default.
    """

    def begin(self, trainer: Trainer) -> None:
        """Get ready; called before the environments are reset."""

    def on_evaluation_start(self, epoch: int) -> None:
        """Prepare for an evaluation at the end of an epoch, from 1."""

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> str | None:
        """Respond to a completed epoch.

        Args:
            step: Environment steps so far.
            epoch: Number of the epoch, from 1.
            values: Its metrics.

        Returns:
            Why the run is to end here, such as ``solved``, or None.
        """
        return None

    def close(self) -> None:
        """Finish; called once, also when the run failed."""

    def _on_step(self) -> bool:
        return True


class ReportToTrackers(RunCallback):
    """Tells trackers of steps and epochs."""

    def __init__(self, trackers: Tracker) -> None:
        super().__init__()
        self.trackers = trackers

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Pass the metrics on."""
        self.trackers.epoch(step, epoch, values)

    def _on_step(self) -> bool:
        self.trackers.step(self.num_timesteps)
        return True


class KeepBest(RunCallback):
    """Saves the policy with the highest success rate, then the highest mean reward."""

    def __init__(self, state: RunState, run_dir: Path) -> None:
        super().__init__()
        self.state = state
        self.directory = run_dir / BEST

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Save the policy if no earlier one was as good."""
        candidate = (values.get("eval/success_rate", 0.0), values["eval/mean_reward"])
        if is_better(candidate, self.state.best):
            self.state.best = candidate
            save_policy(self.state.model, self.directory, epoch)


class KeepPolicies(RunCallback):
    """Keeps the policy of the first epoch and of every so many.

    Args:
        state: With the policy.
        run_dir: Where ``rl_model_epoch_0010`` and the like go.
        every: Epochs between kept policies; 0: none is kept.
    """

    def __init__(self, state: RunState, run_dir: Path, every: int) -> None:
        super().__init__()
        self.state, self.run_dir, self.every = state, run_dir, every

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Save the policy if it is one of these."""
        if self.every and (epoch == 1 or epoch % self.every == 0):
            save_policy(self.state.model, self.run_dir / f"{KEPT}{epoch:04d}", epoch)


class EarlyStop(RunCallback):
    """Ends a run as solved when a metric has held its threshold.

    Args:
        store: The metrics of the run.
        column: The metric.
        threshold: Value that its mean must reach.
        last_n: Over how many epochs. All need the metric.
    """

    def __init__(self, store: MetricStore, column: str, threshold: float, last_n: int) -> None:
        super().__init__()
        self.store, self.column, self.threshold, self.last_n = store, column, threshold, last_n

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> str | None:
        """Compare the last epochs with the threshold."""
        rows = self.store.rows[-self.last_n :]
        newest = [row[self.column] for row in rows if self.column in row]
        return SOLVED if should_stop_early(newest, self.threshold, self.last_n) else None


class Pruning(RunCallback):
    """Ends a run on request.

    Args:
        should_continue: Called after each epoch with step, epoch and metrics.
    """

    def __init__(self, should_continue: Callable[[int, int, Mapping[str, float]], bool]) -> None:
        super().__init__()
        self.should_continue = should_continue

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> str | None:
        """Ask."""
        return None if self.should_continue(step, epoch, values) else PRUNED


class Checkpoints(RunCallback):
    """Saves the run regularly, when it is asked to stop, and after an environment has failed.

    Args:
        state: What is saved.
        run_dir: Where.
        frequency: Environment steps between checkpoints, besides one at the start of the last
            rollout, from which a finished run trains on; 0: only where a run is stopped.

    Attributes:
        stop_request: True when a stop is requested.
    """

    def __init__(self, state: RunState, run_dir: Path, frequency: int) -> None:
        super().__init__()
        self.state = state
        self.run_dir = run_dir
        self.frequency = frequency
        self.stop_request = StopRequest()
        self._next = frequency
        self._total_steps = 0
        self._rollout_start: tuple[int, Snapshot] | None = None
        self._rollout_start_taken = 0.0

    def begin(self, trainer: Trainer) -> None:
        """Note where the run ends."""
        self._total_steps = trainer.cfg.total_steps

    def save(self, step: int, snapshot: Snapshot) -> bool:
        """Save a checkpoint and return whether it worked; a failure is a warning."""
        try:
            resume.save(snapshot, self.run_dir, step)
        except OSError as error:
            _log.warning("No checkpoint at step %d: %s. Training continues.", step, error)
            return False
        return True

    def save_after_failure(self) -> None:
        """Keep what was learned until an environment failed; resumed, new episodes begin."""
        step = self.state.model.num_timesteps
        if not step or not hasattr(self, "model"):  # it has not begun
            return
        if self._rollout_start is not None:
            step, snapshot = self._rollout_start
        elif self._rollouts_are_long():
            return
        else:
            snapshot = self.state.capture(with_episodes=False)
        if step and self.save(step, snapshot):
            _log.info(
                "What was learned until step %d is kept. Continue with: scilab-rl resume %s",
                step,
                self.run_dir,
            )

    def _on_training_start(self) -> None:
        if self.frequency:
            self._next = (self.num_timesteps // self.frequency + 1) * self.frequency

    def _on_rollout_start(self) -> None:
        """Save here, where nothing is pending."""
        steps = self.state.model.num_timesteps
        if self.stop_request:
            self._stop(steps, self.state.capture())
        is_last = 0 < self._total_steps <= steps + rollout_steps(self.state.model)
        is_due = self.frequency > 0 and (steps >= self._next or is_last)
        if is_due:
            if steps >= self._next:
                self._next += self.frequency
            self.save(steps, self.state.capture())
        is_old = time.monotonic() - self._rollout_start_taken > 1.0
        if self._rollouts_are_long() and (is_due or is_old):
            # A long rollout cannot be saved in its middle; a stop then goes back to its beginning,
            # and never behind a checkpoint.
            self._rollout_start = steps, self.state.capture().copy()
            self._rollout_start_taken = time.monotonic()

    def _on_step(self) -> bool:
        if self.stop_request and self._rollout_start is not None:
            self._stop(*self._rollout_start)
        return True

    def _rollouts_are_long(self) -> bool:
        return getattr(self.state.model, "replay_buffer", None) is None

    def _stop(self, step: int, snapshot: Snapshot) -> None:
        if self.save(step, snapshot):
            _log.info("Stopped at step %d. Resume with: scilab-rl resume %s", step, self.run_dir)
        raise TrainingInterrupted(self.stop_request.signal_number)


def rollout_steps(model: Algorithm) -> int:
    """Return how many environment steps a rollout has, or 0 where the parameters do not say."""
    frequency = getattr(model, "train_freq", None) or getattr(model, "n_steps", None)
    if isinstance(frequency, TrainFreq):
        is_in_steps = frequency.unit == TrainFrequencyUnit.STEP
        frequency = frequency.frequency if is_in_steps else None
    return frequency * model.get_env().num_envs if isinstance(frequency, int) else 0
