"""The story of one run, readable from top to bottom."""

from __future__ import annotations

import contextlib
import logging
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl import files
from scilab_rl.config.recorded import as_yaml
from scilab_rl.config.schema import RunConfig
from scilab_rl.errors import (
    CheckpointError,
    ConfigError,
    EnvironmentFailure,
    NumericalError,
    ScilabRLError,
)
from scilab_rl.metrics.criteria import run_score
from scilab_rl.redaction import RedactingFormatter, redact
from scilab_rl.results import RunResult
from scilab_rl.run import provenance
from scilab_rl.run.checks import check_metrics, complete, prepare_torch
from scilab_rl.run.demonstrations import collect_demos, prepare_demos
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory
from scilab_rl.run.parts import (
    make_algorithm,
    make_environments,
    open_trackers,
    restore_policy,
)
from scilab_rl.tracking.base import TrackedRun, TrackerGroup

if TYPE_CHECKING:  # heavy
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.training.callbacks import RunCallback
    from scilab_rl.training.loop import Outcome, Trainer

_log = logging.getLogger(__name__)


def start_run(
    cfg: RunConfig,
    overrides: Sequence[str] = (),
    callbacks: Sequence[RunCallback] = (),
) -> RunResult:
    """Train an algorithm in an environment and leave a complete run behind.

    Args:
        cfg: The composed configuration.
        overrides: What the user typed, to be recorded.
        callbacks: More callbacks of the training, called after its own.

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
            session = build_session(cfg, directory, callbacks)
            collect_demos(cfg, session.algorithm)
            provenance.write(directory, overrides, session.eval_env.envs[0])  # type: ignore[attr-defined]
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
        return session.learn()


def resume_run(
    cfg: RunConfig,
    directory: RunDirectory,
    callbacks: Sequence[RunCallback] = (),
) -> RunResult:
    """Continue an interrupted run as if nothing had happened.

    Args:
        cfg: The run's own configuration, perhaps with more epochs.
        directory: The run.
        callbacks: More callbacks of the training, called after its own.

    Raises:
        CheckpointError: If the run has no whole checkpoint.
        ConfigError: If nothing is left to be trained.
    """
    from scilab_rl.training import resume as continuation

    base = directory.path.resolve().parents[1]
    if Path(cfg.base_logdir).resolve() != base:  # the run was moved, or says something else
        cfg = replace(cfg, base_logdir=str(base))
    # The checkpoint holds what became of the restored policy.
    cfg = complete(replace(cfg, restore_policy=None))
    try:
        snapshot, step = continuation.load_latest(directory.path)
    except CheckpointError as error:
        raise CheckpointError(f"{error}{_way_to_train_on(cfg, directory)}") from error
    ended = directory.read_result()
    if step >= cfg.total_steps and ended and ended.status == "finished":
        raise ConfigError(
            f"The run has completed its {ended.epochs} epochs. To continue training: "
            f"scilab-rl resume {directory} n_epochs=+{ended.epochs}"
        )
    if ended and step < ended.steps:
        _log.info(
            "The newest checkpoint is of step %d: what came after it is trained again, exactly.",
            step,
        )
    with directory.in_use(), _log_file(directory / "train.log"):
        session = build_session(cfg, directory, callbacks)
        trainer = session.trainer
        trainer.callbacks.insert(0, continuation.continue_from(snapshot, trainer.state))
        session.begin()
        return session.learn(resumed_step=step)


def _way_to_train_on(cfg: RunConfig, directory: RunDirectory) -> str:
    """Name the command that starts a new run from a policy of this one, if it has saved any."""
    from scilab_rl.training.policy import BEST, FINISHED

    saved = [name for name in (FINISHED, BEST) if (directory / name).is_dir()]
    if not saved:
        return ""
    return (
        " Networks and optimizers are kept, the replay buffer and counters are not. To train on "
        "from its policy, in a new run: scilab-rl "
        f"algorithm={cfg.algorithm.name} env={cfg.env} restore_policy={directory / saved[0]} "
        f"(and what else '{directory / CONFIG_FILE}' sets for the algorithm)."
    )


@dataclass
class Session:
    """Everything that takes part in a run, built and not yet started."""

    cfg: RunConfig
    directory: RunDirectory
    train_env: VecEnv
    eval_env: VecEnv
    algorithm: Algorithm
    trainer: Trainer
    trackers: TrackerGroup

    def begin(self) -> None:
        """Let the run be seen: its status, its final configuration, and the link to the newest."""
        directory = self.directory
        directory.write_result(RunResult("running", None, 0, 0, 0.0, str(directory)))
        files.write_text(directory / CONFIG_FILE, redact(as_yaml(self.cfg.values())))
        directory.publish_as_last(Path(self.cfg.base_logdir))

    def learn(self, resumed_step: int | None = None) -> RunResult:
        """Train to the end, to a reason to stop earlier, to an interruption or to a failure.

        Args:
            resumed_step: The step of the checkpoint that the run continues from.
        """
        from scilab_rl.training.loop import Outcome

        started, outcome, problem = time.monotonic(), Outcome("failed"), None
        self.trackers.begin(TrackedRun(self.cfg, self.directory.path, resumed_step))
        try:
            outcome = self._learn_until_stopped(resumed_step or 0)
        except Exception as error:
            self._keep_what_can_be_kept(error)
            explained = self._explained(error)
            problem = redact(str(explained))
            if explained is error:
                raise
            raise explained from error
        finally:
            result = self._result(time.monotonic() - started, outcome, problem)
            self._close(result)
        return result

    def _keep_what_can_be_kept(self, error: Exception) -> None:
        """Write the traceback and, when only an environment has failed, a checkpoint."""
        with contextlib.suppress(OSError):  # the disk may be what is wrong
            files.write_text(self.directory / "error.log", redact(traceback.format_exc()))
        if isinstance(error, EnvironmentFailure):
            self.trainer.checkpoints.save_after_failure()

    def _explained(self, error: Exception) -> ScilabRLError:
        from scilab_rl.training.loop import refuse_nan

        if isinstance(error, ScilabRLError):
            return error
        try:  # libraries fail with long messages on weights that are not numbers
            refuse_nan(self.algorithm, {})
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
            closing.callback(self._draw_curve)  # last: no tracker waits for it
            closing.callback(self.trackers.end, result)
            closing.callback(self.trainer.close)
            try:
                self.directory.write_result(result)
            except OSError as error:
                _log.warning("The result of the run cannot be written: %s.", error.strerror)

    def _draw_curve(self) -> None:
        """Draw the learning curve; a run that has ended cannot fail because of a picture."""
        from scilab_rl.run.curves import CURVE_FILE, write_run_curve

        store = self.trainer.state.store
        rows = [{**row, "step": step} for row, step in zip(store.rows, store.steps, strict=True)]
        try:
            write_run_curve(rows, self.directory / CURVE_FILE)
        except Exception as error:  # noqa: BLE001 - the disk may be full, a font missing
            _log.debug("No %s: %s", CURVE_FILE, error)

    def _learn_until_stopped(self, steps_done: int) -> Outcome:
        from scilab_rl.training.policy import FINISHED, save_policy

        with self._watchdog():
            outcome = self.trainer.learn(steps_done)
        save_policy(self.algorithm, self.directory / FINISHED, self.trainer.n_epochs_done)
        return outcome

    def _watchdog(self) -> contextlib.AbstractContextManager[None]:
        from scilab_rl.envs.vectorize import observed_layer
        from scilab_rl.training.watchdog import watchdog

        layers = [observed_layer(env) for env in (self.train_env, self.eval_env)]
        return watchdog(
            lambda: [layer.step_count for layer in layers],
            self.cfg.warn_after_seconds,
            self.directory / "stack.txt",
        )

    def _result(self, seconds: float, outcome: Outcome, error: str | None) -> RunResult:
        store = self.trainer.state.store
        return RunResult(
            outcome.status,
            score=None
            if outcome.status == "failed"
            else run_score(store, self.cfg.hyperopt_criterion),
            epochs=len(store),
            steps=self.algorithm.num_timesteps,
            seconds=seconds,
            run_dir=str(self.directory),
            metrics=store.rows[-1] if store.rows else {},
            error=error,
            signal_number=outcome.signal_number,
        )


def build_session(
    cfg: RunConfig, directory: RunDirectory, callbacks: Sequence[RunCallback] = ()
) -> Session:
    """Make environments, algorithm, trackers and trainer.

    Args:
        cfg: The complete configuration.
        directory: The run's.
        callbacks: More callbacks of the training.

    Raises:
        ConfigError: If they do not fit together.
    """
    from scilab_rl.recording.callback import record_episodes
    from scilab_rl.training.budget import check_budget
    from scilab_rl.training.goals import check_relabeling
    from scilab_rl.training.loop import Trainer

    prepare_torch(cfg)
    train_env, eval_env = make_environments(cfg)
    algorithm = make_algorithm(cfg, train_env)
    check_metrics(cfg, algorithm)
    prepare_demos(cfg, algorithm)
    restore_policy(cfg, algorithm)
    trackers = open_trackers(cfg)
    trainer = Trainer(cfg, algorithm, eval_env, trackers, directory.path)
    check_budget(cfg, algorithm)
    check_relabeling(algorithm, eval_env)
    recording = record_episodes(cfg, trainer, trackers, directory.path)
    trainer.callbacks = [*filter(None, [recording]), *trainer.callbacks, *callbacks]
    return Session(cfg, directory, train_env, eval_env, algorithm, trainer, trackers)


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore it: writers of metrics and checkpoints report a full disk."""


@contextlib.contextmanager
def _log_file(path: Path) -> Iterator[None]:
    """Write the package's log messages to a file too."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(RedactingFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("scilab_rl")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
