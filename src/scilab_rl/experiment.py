"""The story of one run, readable from top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from scilab_rl import config, files, provenance
from scilab_rl.assembly import (
    complete,
    env_settings,
    make_algorithm,
    make_environments,
    open_trackers,
    prepare_torch,
    restore_policy,
)
from scilab_rl.errors import (
    ConfigError,
    EnvironmentError_,
    NumericalError,
    ScilabRLError,
    did_you_mean,
)
from scilab_rl.masking import MaskingFormatter, mask
from scilab_rl.metrics.criteria import final_score
from scilab_rl.results import CONFIG_FILE, RunDirectory, RunResult
from scilab_rl.seeding import derive_seed
from scilab_rl.tracking.base import RunInfo, TrackerGroup

_log = logging.getLogger(__name__)
_FALLBACK_CRITERION = "eval/mean_reward"
_SMALL_BUFFER = 1000


def run(
    cfg: DictConfig,
    overrides: Sequence[str] = (),
    watch: Callable[[Session], object] | None = None,
) -> RunResult:
    """Train an algorithm in an environment and leave a complete run behind.

    Args:
        cfg: The composed configuration.
        overrides: What the user typed, to be recorded.
        watch: Called with the session before it learns, to follow it from outside.

    Returns:
        The result, as it is stored in the run's ``result.json``.

    Raises:
        ConfigError: If the configuration cannot work; nothing is left behind.
        ScilabRLError: If the run failed; its directory says how.
    """
    cfg = complete(cfg)
    directory = RunDirectory.create(Path(cfg.base_logdir), cfg.env, cfg.algorithm.name, cfg.seed)
    with directory.in_use(), _log_file(directory / "train.log"):
        try:
            session = build(cfg, directory)
            provenance.write(directory, overrides, session.eval_env.envs[0])
            session.begin()
        except ConfigError:
            directory.discard()
            raise
        except OSError as error:
            directory.discard()
            raise ConfigError(
                f"'{directory}' cannot be written: {error.strerror}. Choose another place with "
                "base_logdir=DIR."
            ) from error
        if watch is not None:
            watch(session)
        return session.learn()


def resume(
    cfg: DictConfig,
    directory: RunDirectory,
    watch: Callable[[Session], object] | None = None,
) -> RunResult:
    """Continue an interrupted run as if nothing had happened.

    Args:
        cfg: The run's own configuration, perhaps with more epochs.
        directory: The run.
        watch: Called with the session before it learns, to follow it from outside.

    Raises:
        CheckpointError: If the run has no whole checkpoint.
    """
    from scilab_rl.training import resume as continuation

    cfg = complete(cfg)
    cfg.restore_policy = None  # the checkpoint holds what became of it
    snapshot, step = continuation.load_latest(directory.path)
    with directory.in_use(), _log_file(directory / "train.log"):
        session = build(cfg, directory)
        continuation.continue_from(snapshot, session.algorithm, session.trainer)
        session.begin()
        return session.learn(resumed_step=step)


def measure(directory: RunDirectory, n_episodes: int) -> dict[str, float]:
    """Evaluate the finished policy of a run in episodes that the run has never seen.

    Args:
        directory: The run.
        n_episodes: How many episodes.

    Returns:
        The metrics, by the names of an evaluation.
    """
    from scilab_rl.envs.vectorize import make_eval_env
    from scilab_rl.training.evaluation import evaluate
    from scilab_rl.training.trainer import FINISHED, load_policy

    cfg = complete(config.load_recorded(directory / CONFIG_FILE))
    if "buffer_size" in cfg.algorithm:  # a policy that only acts needs no replay buffer
        cfg.algorithm.buffer_size = min(cfg.algorithm.buffer_size, _SMALL_BUFFER)
    env = make_eval_env(env_settings(cfg))
    try:
        algorithm = make_algorithm(cfg, env)
        load_policy(algorithm, directory / FINISHED)
        seed = derive_seed(cfg.seed, "measure")
        return evaluate(algorithm, env, n_episodes, seed).metrics()
    finally:
        env.close()


@dataclass
class Session:
    """Everything that takes part in a run, built and not yet started."""

    cfg: DictConfig
    directory: RunDirectory
    train_env: Any
    eval_env: Any
    algorithm: Any
    trainer: Any
    trackers: TrackerGroup
    showing: Any

    def begin(self) -> None:
        """Let the run be seen: its status, its final configuration, and the link to the newest."""
        directory = self.directory
        directory.write_result(RunResult("running", None, 0, 0, 0.0, str(directory)))
        files.write_text(directory / CONFIG_FILE, mask(OmegaConf.to_yaml(self.cfg, resolve=True)))
        directory.publish_as_last(Path(self.cfg.base_logdir))

    def learn(self, resumed_step: int | None = None) -> RunResult:
        """Train to the end, to an early stop, to an interruption or to a failure.

        Args:
            resumed_step: The step of the checkpoint that the run continues from.
        """
        started = time.monotonic()
        outcome: dict[str, Any] = {"status": "failed"}
        self.trackers.begin(
            run_info(self.cfg, self.directory, self.trainer.total_steps, resumed_step)
        )
        try:
            self._learn_until_stopped(outcome, resumed_step or 0)
        except Exception as error:
            self._keep_what_can_be_kept(error)
            explained = self._explained(error)
            outcome["error"] = mask(str(explained))
            if explained is error:
                raise
            raise explained from error
        finally:
            result = self._result(time.monotonic() - started, **outcome)
            self._close(result)
        return result

    def _keep_what_can_be_kept(self, error: Exception) -> None:
        """Write the traceback and, when only an environment has failed, a checkpoint."""
        with contextlib.suppress(OSError):  # the disk may be what is wrong
            files.write_text(self.directory / "error.log", mask(traceback.format_exc()))
        if isinstance(error, EnvironmentError_):
            self.trainer.save_after_failure()

    def _explained(self, error: Exception) -> ScilabRLError:
        if isinstance(error, ScilabRLError):
            return error
        try:  # libraries fail in many words on weights that are no numbers
            self.trainer.refuse_nan({})
        except NumericalError as cause:
            return cause
        return ScilabRLError(
            f"{type(error).__name__}: {error} (details in {self.directory / 'error.log'})"
        )

    def _close(self, result: RunResult) -> None:
        """Write the result and close everything, whatever goes wrong meanwhile."""
        with contextlib.ExitStack() as closing:
            closing.callback(self.eval_env.close)
            closing.callback(self.train_env.close)
            closing.callback(self.trackers.end, result)
            closing.callback(self.showing.close)
            try:
                self.directory.write_result(result)
            except OSError as error:
                _log.warning("The result of the run cannot be written: %s.", error.strerror)

    def _learn_until_stopped(self, outcome: dict[str, Any], steps_done: int) -> None:
        from scilab_rl.training.interruption import TrainingInterrupted, polite_stop
        from scilab_rl.training.trainer import FINISHED

        trainer = self.trainer
        self.showing.begin()
        with polite_stop() as trainer.stop_request, self._watchdog():
            try:
                self.algorithm.learn(
                    trainer.total_steps - steps_done,
                    callback=trainer,
                    log_interval=None,
                    reset_num_timesteps=steps_done == 0,
                )
                outcome["status"] = "stopped_early" if trainer.stopped_early else "finished"
            except TrainingInterrupted as interruption:
                outcome["status"] = "interrupted"
                outcome["signal_number"] = interruption.signal_number
        trainer.save_policy(FINISHED)

    def _watchdog(self) -> contextlib.AbstractContextManager[None]:
        from scilab_rl.envs.vectorize import observed_layer
        from scilab_rl.training.watchdog import watchdog

        layers = [observed_layer(env) for env in (self.train_env, self.eval_env)]
        return watchdog(
            lambda: [layer.step_count for layer in layers],
            self.cfg.warn_after_seconds,
            self.directory / "stack.txt",
        )

    def _result(self, seconds: float, **outcome: Any) -> RunResult:
        trainer = self.trainer
        failed = outcome["status"] == "failed"
        return RunResult(
            score=None if failed else score(trainer.store, self.cfg),
            epochs=trainer.n_epochs_done,
            steps=self.algorithm.num_timesteps,
            seconds=seconds,
            run_dir=str(self.directory),
            metrics=trainer.store.rows[-1] if trainer.store.rows else {},
            **outcome,
        )


def build(cfg: DictConfig, directory: RunDirectory) -> Session:
    """Make environments, algorithm, trackers and trainer.

    Raises:
        ConfigError: If they do not fit together.
    """
    from scilab_rl.envs.vectorize import observed_layer
    from scilab_rl.training.trainer import Trainer

    prepare_torch(cfg)
    train_env, eval_env = make_environments(cfg)
    algorithm = make_algorithm(cfg, train_env)
    restore_policy(cfg, algorithm)
    trackers = open_trackers(cfg)
    trainer = Trainer(training_plan(cfg), eval_env, trackers, directory.path)
    trainer.watch(algorithm, observed_layer(train_env))
    showing = show_episodes(cfg, trainer, train_env, algorithm, directory)
    return Session(cfg, directory, train_env, eval_env, algorithm, trainer, trackers, showing)


def training_plan(cfg: DictConfig) -> Any:
    """Pick the numbers that shape the training from the configuration."""
    from scilab_rl.training.trainer import TrainingPlan

    return TrainingPlan(
        **{field.name: cfg[field.name] for field in dataclasses.fields(TrainingPlan)}
    )


def show_episodes(
    cfg: DictConfig, trainer: Any, train_env: Any, algorithm: Any, directory: RunDirectory
) -> Any:
    """Prepare the live view or the recording of episodes, if one is wanted."""
    from scilab_rl.training.showing import ShowingPlan, make_showing

    plan = ShowingPlan(
        render=cfg.render,
        render_freq=cfg.render_freq,
        render_frames_per_clip=cfg.render_frames_per_clip,
        record_when=cfg.record_when,
        viewer_host=cfg.viewer_host,
        render_metrics_train=list(cfg.render_metrics_train),
        render_metrics_test=list(cfg.render_metrics_test),
        n_test_rollouts=cfg.n_test_rollouts,
        env_id=cfg.env,
        algorithm=cfg.algorithm.name,
    )
    return make_showing(plan, trainer, train_env, algorithm, directory.path)


def run_info(
    cfg: DictConfig, directory: RunDirectory, total_steps: int, resumed_step: int | None
) -> RunInfo:
    """Collect what trackers want to know."""
    return RunInfo(
        run_dir=directory.path,
        base_logdir=Path(cfg.base_logdir),
        env=cfg.env,
        algorithm=cfg.algorithm.name,
        seed=cfg.seed,
        total_steps=total_steps,
        n_epochs=cfg.n_epochs,
        parameters={
            name: mask(value) if isinstance(value, str) else value
            for name, value in config.flat(cfg).items()
        },
        project=cfg.project_name,
        entity=cfg.entity,
        group=cfg.group,
        tags=tuple(cfg.tags or ()),
        notes=cfg.info,
        resumed_step=resumed_step,
    )


def criterion_of(values: Mapping[str, float], criterion: str) -> float:
    """Return the criterion in one evaluation; tasks without success are judged by reward.

    Raises:
        ConfigError: If the evaluation does not have it.
    """
    if criterion not in values and criterion.startswith("eval/success"):
        criterion = _FALLBACK_CRITERION
    if criterion not in values:
        raise ConfigError(
            f"hyperopt_criterion: the run records no '{criterion}'."
            f"{did_you_mean(criterion, values)}"
        )
    return float(values[criterion])


def score(store: Any, cfg: DictConfig) -> float | None:
    """Return the run's score; tasks without a notion of success are scored by reward."""
    value = final_score(store, cfg.hyperopt_criterion)
    if value is None and cfg.hyperopt_criterion.startswith("eval/success"):
        return final_score(store, _FALLBACK_CRITERION)
    return value


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Say nothing: a full disk is told by those who write metrics and checkpoints."""


@contextlib.contextmanager
def _log_file(path: Path) -> Iterator[None]:
    """Write the package's log messages to a file too."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(MaskingFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("scilab_rl")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
