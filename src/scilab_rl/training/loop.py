"""The course of a training run: epochs, each of which ends with an evaluation.

The algorithm's own `learn` stays in charge of learning; the trainer is a callback of it, in
Stable-Baselines3's convention, which our one-file algorithms follow too. All other duties are
callbacks of the trainer, see `training.callbacks`.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import NumericalError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.inspector import INTRINSIC_REWARD, AgentInspector
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.seeding import derive_seed
from scilab_rl.tracking.base import Tracker
from scilab_rl.training.callbacks import (
    Checkpoints,
    EarlyStop,
    KeepBest,
    KeepPolicies,
    ReportToTrackers,
    RunCallback,
)
from scilab_rl.training.evaluation import evaluate
from scilab_rl.training.instability import InstabilityRecord
from scilab_rl.training.interruption import TrainingInterrupted, graceful_shutdown
from scilab_rl.training.policy import share_memory
from scilab_rl.training.state import RunState
from scilab_rl.training.statistics import RolloutStatistics

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """How training ended.

    Attributes:
        status: ``finished``, ``interrupted``, or why a callback ended it with epochs left.
        signal_number: The signal that interrupted it, or 0.
    """

    status: str
    signal_number: int = 0


class Trainer(CallbackList):
    """Divides `learn` into epochs, evaluates at the end of each, and tells its callbacks.

    Args:
        cfg: The configuration of the run.
        model: The algorithm, with the environments in which it learns.
        eval_env: Environment for evaluation.
        trackers: Told about each epoch and each training episode.
        run_dir: Where policies and checkpoints are saved.

    Attributes:
        callbacks: Called in order.
        state: What a checkpoint holds.
        checkpoints: The callback that saves it.
    """

    def __init__(
        self, cfg: RunConfig, model: Algorithm, eval_env: VecEnv, trackers: Tracker, run_dir: Path
    ) -> None:
        self.cfg = cfg
        self.eval_env = eval_env
        self.run_dir = run_dir
        logger, train_env = MetricLogger(), observed_layer(model.get_env())
        model.set_logger(logger)
        inspector = AgentInspector(model)
        intrinsic = inspector if INTRINSIC_REWARD in inspector.quantities else None
        statistics = RolloutStatistics(logger, train_env.num_envs, trackers.episode, intrinsic)
        self.state = RunState(model, logger, statistics)
        self.checkpoints = Checkpoints(self.state, run_dir, cfg.save_model_freq)
        self._instabilities = InstabilityRecord(run_dir / "unstable")
        train_env.observers += [statistics, self._instabilities]
        keep_best, report = KeepBest(self.state, run_dir), ReportToTrackers(trackers)
        kept = KeepPolicies(self.state, run_dir, cfg.keep_policies)
        stop = cfg.early_stop_data_column, cfg.early_stop_threshold, cfg.early_stop_last_n
        early_stop = EarlyStop(self.state.store, *stop)
        super().__init__([keep_best, kept, report, early_stop, self.checkpoints])
        self._stop_reason: str | None = None
        self._epoch_started = 0.0
        self._epoch_first_step = 0
        self._has_warned_of_silence = False

    @property
    def n_epochs_done(self) -> int:
        """Completed epochs."""
        return len(self.state.store)

    def learn(self, steps_done: int = 0) -> Outcome:
        """Train to the end, to a reason to stop earlier, or to an interruption.

        Args:
            steps_done: Environment steps of an earlier process.
        """
        for callback in self._run_callbacks():
            callback.begin(self)
        with graceful_shutdown() as self.checkpoints.stop_request:
            try:
                self.state.model.learn(
                    self.cfg.total_steps - steps_done,
                    callback=self,
                    log_interval=None,
                    reset_num_timesteps=steps_done == 0,
                )
            except TrainingInterrupted as interruption:
                return Outcome("interrupted", interruption.signal_number)
        return Outcome(self._stop_reason or "finished")

    def evaluate(self) -> dict[str, float]:
        """Evaluate the policy as it is now; the same at the end of the same epoch, always."""
        started = time.monotonic()
        share_memory(self.state.model.get_env(), self.eval_env)
        for callback in self._run_callbacks():
            callback.on_evaluation_start(self.n_epochs_done + 1)
        seed = derive_seed(self.cfg.seed, "eval", self.n_epochs_done)
        evaluation = evaluate(self.state.model, self.eval_env, self.cfg.n_test_rollouts, seed)
        values = evaluation.metrics(reports_success=self._reports_success())
        self._warn_of_silent_episodes(values)
        return values | {"time/eval_seconds": time.monotonic() - started}

    def close(self) -> None:
        """Close the callbacks, whatever goes wrong meanwhile."""
        with contextlib.ExitStack() as closing:
            for callback in reversed(self._run_callbacks()):
                closing.callback(callback.close)

    def update_child_locals(self, locals_: dict[str, object]) -> None:
        """Do nothing: since the training's start, callbacks share the trainer's dictionary."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._begin_epoch()

    def _on_step(self) -> bool:
        goes_on = super()._on_step()
        if self.num_timesteps < (self.n_epochs_done + 1) * self.cfg.eval_after_n_steps:
            return goes_on
        self._end_epoch()
        return goes_on and self._stop_reason is None and self.n_epochs_done < self.cfg.n_epochs

    def _run_callbacks(self) -> list[RunCallback]:
        return [callback for callback in self.callbacks if isinstance(callback, RunCallback)]

    def _begin_epoch(self) -> None:
        self._epoch_started = time.monotonic()
        self._epoch_first_step = self.num_timesteps

    def _end_epoch(self) -> None:
        values = self._training_metrics() | self.evaluate()
        refuse_nan(self.state.model, values)
        # What is not defined in an epoch (the explained variance of equal returns) is a gap.
        values = {name: value for name, value in values.items() if math.isfinite(value)}
        self.state.store.append(self.num_timesteps, values)
        arguments = self.num_timesteps, self.n_epochs_done, values
        reasons = [callback.on_epoch(*arguments) for callback in self._run_callbacks()]
        if self.n_epochs_done < self.cfg.n_epochs:
            self._stop_reason = next((reason for reason in reasons if reason is not None), None)
        self._begin_epoch()

    def _training_metrics(self) -> dict[str, float]:
        seconds = time.monotonic() - self._epoch_started
        steps = self.num_timesteps - self._epoch_first_step
        return {
            **self.state.logger.take(),
            **self.state.statistics.metrics(reports_success=self._reports_success()),
            **self._instabilities.metrics(),
            "time/total_timesteps": float(self.num_timesteps),
            "time/fps": steps / max(seconds, 1e-9),
            "time/train_seconds": seconds,
        }

    def _reports_success(self) -> bool:
        """Return whether any episode so far, of training or evaluation, has reported success."""
        names = ("eval/success_rate", "rollout/success_rate")
        before = any(name in row for row in self.state.store.rows for name in names)
        return before or self.state.statistics.reports_success

    def _warn_of_silent_episodes(self, values: Mapping[str, float]) -> None:
        n_silent = values.get("eval/success_not_reported", 0)
        if n_silent and not self._has_warned_of_silence:
            self._has_warned_of_silence = True
            _log.warning(
                "%d of %d evaluation episodes reported no success or failure at their end; they "
                "count as not successful (eval/success_not_reported).",
                n_silent,
                self.cfg.n_test_rollouts,
            )


def refuse_nan(model: Algorithm, values: Mapping[str, float]) -> None:
    """Stop a run whose losses or weights are not finite: all that follows would be noise.

    Args:
        model: The algorithm.
        values: Metrics to look at, besides the weights.

    Raises:
        NumericalError: With the first that is not finite.
    """
    broken = {
        name: value
        for name, value in values.items()
        if ("loss" in name or name.startswith("eval/")) and not math.isfinite(value)
    }
    policy = getattr(model, "policy", None)
    if isinstance(policy, torch.nn.Module):
        broken |= {
            f"weight {name}": math.nan
            for name, weight in policy.named_parameters()
            if not torch.isfinite(weight).all()
        }
    names = ("learning_rate", "gamma", "batch_size")
    shown = ", ".join(f"{name}={getattr(model, name)}" for name in names if hasattr(model, name))
    for name, value in broken.items():
        raise NumericalError(
            f"{name} is {value} after {model.num_timesteps} steps ({shown}). "
            "Often the learning rate is too high."
        )
