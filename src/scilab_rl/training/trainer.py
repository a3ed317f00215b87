"""The course of a training run: epochs, evaluation, best policy, early stop.

The algorithm's own `learn` stays in charge of learning; the trainer hangs into it as a callback, in
Stable-Baselines3's convention, which our one-file algorithms follow too.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from scilab_rl.algorithms.inspection import INTRINSIC_REWARD, Inspection
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.errors import NumericalError
from scilab_rl.metrics.criteria import is_better, should_stop_early
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.store import MetricStore
from scilab_rl.seeding import derive_seed
from scilab_rl.tracking.base import Tracker
from scilab_rl.training import checkpoint, foreign, resume
from scilab_rl.training.evaluation import evaluate
from scilab_rl.training.instability import InstabilityRecord
from scilab_rl.training.interruption import StopRequest, TrainingInterrupted
from scilab_rl.training.snapshot import Snapshot, capture, restore
from scilab_rl.training.statistics import RolloutStatistics

BEST, FINISHED = "rl_model_best", "rl_model_finished"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingPlan:
    """The numbers of the configuration that shape a run.

    Attributes:
        eval_after_n_steps: Environment steps per epoch, over all environments.
        n_epochs: Most epochs.
        n_test_rollouts: Evaluation episodes after each epoch.
        early_stop_data_column: Metric that may end the run.
        early_stop_threshold: Value at which it does.
        early_stop_last_n: Over how many epochs it is averaged.
        save_model_freq: Environment steps between checkpoints; 0 saves none.
        seed: Seed of the run.
    """

    eval_after_n_steps: int
    n_epochs: int
    n_test_rollouts: int
    early_stop_data_column: str
    early_stop_threshold: float
    early_stop_last_n: int
    save_model_freq: int
    seed: int


class Trainer(BaseCallback):
    """Divides `learn` into epochs and does what belongs to the end of each.

    Args:
        plan: The numbers of the configuration.
        eval_env: Environment for evaluation.
        trackers: Told about each epoch and each training episode.
        run_dir: Where policies are saved.

    Attributes:
        store: One row of metrics per epoch.
        metric_logger: The logger that the algorithm records to.
        stopped_early: Whether the early-stop rule ended the run.
        stop_request: Becomes true when somebody asks to stop.
        before_evaluation: Called with the epoch's number before it is evaluated.
        may_go_on: Called after each epoch with step, epoch and metrics; one False ends the run.
        after_step: Called when the algorithm has recorded all that belongs to a step.
    """

    def __init__(
        self, plan: TrainingPlan, eval_env: VecEnv, trackers: Tracker, run_dir: Path
    ) -> None:
        super().__init__()
        self.plan = plan
        self.eval_env = eval_env
        self.trackers = trackers
        self.run_dir = run_dir
        self.store = MetricStore()
        self.metric_logger = MetricLogger()
        self.stopped_early = False
        self.best: tuple[float, ...] | None = None
        self.before_evaluation: list[Callable[[int], Any]] = []
        self.may_go_on: list[Callable[[int, int, Mapping[str, float]], bool]] = []
        self.after_step: list[Callable[[], Any]] = []
        self.at_first_rollout: Callable[[], Any] | None = None
        self.stop_request = StopRequest()
        self.statistics: RolloutStatistics | None = None
        self.instabilities = InstabilityRecord(run_dir / "unstable")
        self._epoch_started = 0.0
        self._epoch_first_step = 0
        self._next_checkpoint = plan.save_model_freq
        self._boundary: tuple[int, Snapshot] | None = None
        self._boundary_taken = 0.0

    def watch(self, model: Any, train_env: ObservedVecEnv) -> None:
        """Attach to an algorithm and the environments it learns in."""
        model.set_logger(self.metric_logger)
        mind = Inspection(model)
        self.statistics = RolloutStatistics(
            self.metric_logger,
            train_env.num_envs,
            self.trackers.episode,
            curious=mind if INTRINSIC_REWARD in mind.quantities else None,
        )
        train_env.observers += [self.statistics, self.instabilities]

    @property
    def total_steps(self) -> int:
        """Environment steps of all epochs together."""
        return self.plan.eval_after_n_steps * self.plan.n_epochs

    @property
    def n_epochs_done(self) -> int:
        """Completed epochs."""
        return len(self.store)

    def _on_training_start(self) -> None:
        self._epoch_started = time.monotonic()
        self._epoch_first_step = self.num_timesteps
        frequency = self.plan.save_model_freq
        if frequency:
            self._next_checkpoint = (self.num_timesteps // frequency + 1) * frequency

    def _on_rollout_start(self) -> None:
        """Save here, where nothing is pending."""
        if self.at_first_rollout is not None:
            self.at_first_rollout()
            self.at_first_rollout = None
        steps = self.model.num_timesteps
        if self.stop_request:
            self._stop(steps, resume.take(self.model, self))
        is_due = self.plan.save_model_freq > 0 and steps >= self._next_checkpoint
        if is_due:
            self._next_checkpoint += self.plan.save_model_freq
            self._save_checkpoint(steps, resume.take(self.model, self))
        is_old = time.monotonic() - self._boundary_taken > 1.0
        if self._rollouts_are_long() and (is_due or is_old):
            # A long rollout cannot be saved in its middle; a stop then goes back to its beginning,
            # and never behind a checkpoint.
            self._boundary = steps, resume.frozen(resume.take(self.model, self))
            self._boundary_taken = time.monotonic()

    def _on_step(self) -> bool:
        for finish in self.after_step:
            finish()
        self.trackers.step(self.num_timesteps)
        if self.stop_request and self._boundary is not None:
            self._stop(*self._boundary)
        if self.num_timesteps < (self.n_epochs_done + 1) * self.plan.eval_after_n_steps:
            return True
        self._end_epoch()
        return not self.stopped_early and self.n_epochs_done < self.plan.n_epochs

    def _end_epoch(self) -> None:
        training_seconds = time.monotonic() - self._epoch_started
        values = self._training_metrics(training_seconds)
        values |= self._evaluate()
        self.refuse_nan(values)
        # What is not defined in an epoch (the explained variance of equal returns) is a gap.
        values = {name: value for name, value in values.items() if math.isfinite(value)}
        self.store.append(self.num_timesteps, values)
        self._keep_if_best(values)
        self.trackers.epoch(self.num_timesteps, self.n_epochs_done, values)
        plan = self.plan
        self.stopped_early = should_stop_early(
            self.store.series(plan.early_stop_data_column),
            plan.early_stop_threshold,
            plan.early_stop_last_n,
        )
        for ask in self.may_go_on:
            self.stopped_early |= not ask(self.num_timesteps, self.n_epochs_done, values)
        self._epoch_started = time.monotonic()
        self._epoch_first_step = self.num_timesteps

    def _training_metrics(self, seconds: float) -> dict[str, float]:
        assert self.statistics is not None
        steps = self.num_timesteps - self._epoch_first_step
        return {
            **self.metric_logger.take(),
            **self.statistics.metrics(),
            **self.instabilities.metrics(),
            "time/total_timesteps": float(self.num_timesteps),
            "time/fps": steps / max(seconds, 1e-9),
            "time/train_seconds": seconds,
        }

    def _evaluate(self) -> dict[str, float]:
        started = time.monotonic()
        train_env = self.model.get_env()
        if train_env is not None and _has_normalization(train_env):
            sync_envs_normalization(train_env, self.eval_env)
        seed = derive_seed(self.plan.seed, "eval", self.n_epochs_done)
        for prepare in self.before_evaluation:
            prepare(self.n_epochs_done + 1)
        evaluation = evaluate(self.model, self.eval_env, self.plan.n_test_rollouts, seed)
        return evaluation.metrics() | {"time/eval_seconds": time.monotonic() - started}

    def refuse_nan(self, values: Mapping[str, float]) -> None:
        """Stop a run whose losses or weights are no numbers: all that follows would be noise.

        Args:
            values: Metrics to look at, besides the weights.

        Raises:
            NumericalError: With the first that is none.
        """
        broken = {
            name: value
            for name, value in values.items()
            if ("loss" in name or name.startswith("eval/")) and not math.isfinite(value)
        }
        policy = getattr(getattr(self, "model", None), "policy", None)
        if isinstance(policy, torch.nn.Module):
            broken |= {
                f"weight {name}": math.nan
                for name, weight in policy.named_parameters()
                if not torch.isfinite(weight).all()
            }
        for name, value in broken.items():
            raise NumericalError(
                f"{name} is {value} after {self.num_timesteps} steps "
                f"({_hyperparameters(self.model)}). Often the learning rate is too high."
            )

    def _keep_if_best(self, values: Mapping[str, float]) -> None:
        candidate = (values.get("eval/success_rate", 0.0), values["eval/mean_reward"])
        if is_better(candidate, self.best):
            self.best = candidate
            self.save_policy(BEST)

    def _rollouts_are_long(self) -> bool:
        return getattr(self.model, "replay_buffer", None) is None

    def _save_checkpoint(self, step: int, snapshot: Snapshot) -> bool:
        try:
            resume.save(snapshot, self.run_dir, step)
        except OSError as error:
            _log.warning("No checkpoint at step %d: %s. Training goes on.", step, error)
            return False
        return True

    def _stop(self, step: int, snapshot: Snapshot) -> None:
        if self._save_checkpoint(step, snapshot):
            _log.info("Stopped at step %d. Resume with: scilab-rl resume %s", step, self.run_dir)
        raise TrainingInterrupted(self.stop_request.signal_number)

    def save_after_failure(self) -> None:
        """Keep what was learned until an environment failed; resumed, new episodes begin."""
        model = getattr(self, "model", None)
        if model is None or not model.num_timesteps:
            return
        if self._boundary is not None:
            step, snapshot = self._boundary
        elif self._rollouts_are_long():
            return
        else:
            step = model.num_timesteps
            snapshot = resume.take(model, self, with_episodes=False)
        if step and self._save_checkpoint(step, snapshot):
            _log.info(
                "What was learned until step %d is kept. Go on with: scilab-rl resume %s",
                step,
                self.run_dir,
            )

    def save_policy(self, name: str) -> None:
        """Save everything but the replay buffer under this name in the run directory."""
        state = policy_state(self.model)
        try:
            checkpoint.save(
                capture(state, with_buffers=False),
                self.run_dir / name,
                step=self.num_timesteps,
                about={"epoch": self.n_epochs_done},
            )
        except OSError as error:
            _log.warning("The policy %s could not be saved: %s. Training goes on.", name, error)


def load_policy(model: Any, directory: Path) -> None:
    """Put a saved policy, with its optimizers and normalisation, into an algorithm.

    Args:
        model: The algorithm.
        directory: As `Trainer.save_policy` writes it; or a zip of Stable-Baselines3, if the user
            trusts it.

    Raises:
        CheckpointError: If the policy is damaged or was saved by another algorithm.
        ConfigError: If there is none, or it is a zip that is not trusted.
    """
    if (archive := foreign.find_archive(directory)) is not None:
        foreign.load_archive(model, archive)
    else:
        restore(policy_state(model), checkpoint.load(directory))


def policy_state(model: Any) -> dict[str, Any]:
    """Return the parts of a run that make a policy: the algorithm and its normalisation."""
    state = {"algorithm": model}
    if (normalization := find_normalization(model.get_env())) is not None:
        state["obs_rms"] = normalization.obs_rms
        state["ret_rms"] = normalization.ret_rms
    return state


def find_normalization(env: Any) -> VecNormalize | None:
    """Return the normalising layer of a vector environment, if it has one."""
    while env is not None:
        if isinstance(env, VecNormalize):
            return env
        env = getattr(env, "venv", None)
    return None


def _has_normalization(env: VecEnv) -> bool:
    return find_normalization(env) is not None


def _hyperparameters(model: Any) -> str:
    names = ("learning_rate", "gamma", "batch_size")
    shown = {name: getattr(model, name) for name in names if hasattr(model, name)}
    return ", ".join(f"{name}={value}" for name, value in shown.items())
