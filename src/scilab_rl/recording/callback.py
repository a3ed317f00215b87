"""Which episodes are shown, and where: every few epochs, one of training and some of evaluation."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.frames import frame_rate, simulator_state
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import ConfigError, RenderingError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.declared import how_to_declare, recorded_metrics
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.names import is_recorded
from scilab_rl.metrics.probes import ShownMetrics, answerable, is_known, resolve_metrics
from scilab_rl.metrics.triggers import Trigger, parse_trigger
from scilab_rl.recording.recorder import ClipRecorder
from scilab_rl.recording.records import FOLDER, ClipInfo
from scilab_rl.recording.timeline import RecordSink, Timeline
from scilab_rl.tracking.base import Tracker
from scilab_rl.training.callbacks import RunCallback
from scilab_rl.training.loop import Trainer

_log = logging.getLogger(__name__)
RECORD, DISPLAY = "record", "display"
# By default, the first supported metric of each row is drawn.
_DEFAULT_METRICS = (("q_values", "value"), ("critic_variance",), ("goal_distance",), ("reward",))
_FOR_TRACKERS = (".mp4", ".html")


class Recording(RunCallback):
    """Tells the timelines when to show something.

    Args:
        train: Timeline of the training environments.
        evaluation: Timeline of the environment for evaluation.
        render_freq: Epochs between shown ones.
        n_eval_clips: How many episodes of a shown evaluation are shown.
        sinks: Closed at the end.
    """

    def __init__(
        self,
        train: Timeline,
        evaluation: Timeline,
        *,
        render_freq: int,
        n_eval_clips: int,
        sinks: Sequence[RecordSink],
    ) -> None:
        super().__init__()
        self.train = train
        self.evaluation = evaluation
        self.render_freq = render_freq
        self.n_eval_clips = n_eval_clips
        self.sinks = sinks

    def begin(self, trainer: Trainer) -> None:
        """Show the first epoch from its first reset on."""
        self._show_training(trainer.n_epochs_done + 1)

    def on_evaluation_start(self, epoch: int) -> None:
        """Show the evaluation and, from its next episode on, the training that follows."""
        if self._is_shown(epoch):
            self.evaluation.show(epoch, self.n_eval_clips)
        self._show_training(epoch + 1)

    def close(self) -> None:
        """Finish what is being shown and wait until it is written."""
        self.train.close()
        self.evaluation.close()
        for sink in self.sinks:
            sink.close()

    def _on_step(self) -> bool:
        self.evaluation.close()  # no episode continues after an evaluation
        self.train.complete_step()
        return True

    def _is_shown(self, epoch: int) -> bool:
        return epoch == 1 or epoch % self.render_freq == 0

    def _show_training(self, epoch: int) -> None:
        if self._is_shown(epoch):
            self.train.show(epoch)


def record_episodes(
    cfg: RunConfig, trainer: Trainer, tell: Tracker, folder: Path
) -> Recording | None:
    """Return the callback that shows or records episodes, or None if nothing is shown.

    Args:
        cfg: The configuration of the run.
        trainer: The training.
        tell: Gets videos and pages.
        folder: Directory of the run.

    Raises:
        ConfigError: If a metric is unknown or the algorithm cannot answer it.
        MissingDependencyError: If the live view is not installed.
    """
    if cfg.render not in (RECORD, DISPLAY):
        return None
    algorithm = trainer.state.model
    inspector = AgentInspector(algorithm)
    trigger = parse_trigger(cfg.record_when) if cfg.record_when else None
    watched = [trigger.metric] if trigger is not None and trigger.metric else []
    train_metrics, test_metrics = _shown_metrics(cfg, inspector, watched)
    train_env, eval_env = observed_layer(algorithm.get_env()), observed_layer(trainer.eval_env)
    leave_out_impossible_pictures(eval_env, train_env)
    panels = tuple(dict.fromkeys(train_metrics.names + test_metrics.names))
    warned: set[str] = set()
    sinks = [_make_sink(cfg, panels, trigger, folder, tell.artifact)]

    def timeline(
        env: ObservedVecEnv, metrics: ShownMetrics, logger: MetricLogger | None = None
    ) -> Timeline:
        return Timeline(
            env,
            inspector,
            metrics,
            _clip_namer(cfg, env, metrics.names, folder.name, algorithm),
            sinks,
            frames_per_clip=cfg.render_frames_per_clip,
            logger=logger,
            warned=warned,
        )

    return Recording(
        timeline(train_env, train_metrics, trainer.state.logger),
        timeline(eval_env, test_metrics),
        render_freq=cfg.render_freq,
        n_eval_clips=cfg.n_test_rollouts if cfg.render == DISPLAY or trigger else 1,
        sinks=sinks,
    )


def _shown_metrics(
    cfg: RunConfig, inspector: AgentInspector, watched: Sequence[str]
) -> tuple[ShownMetrics, ShownMetrics]:
    """Return the metrics of training and of evaluation, those of ``record_when`` included."""
    name, recorded = cfg.algorithm.name, recorded_metrics(inspector.algorithm)

    def of_evaluation(key: str, names: Sequence[str]) -> ShownMetrics:
        _refuse_recorded(key, names, inspector, recorded.names)
        return resolve_metrics(names, inspector, (), key=key, algorithm_name=name)

    of_evaluation("record_when", watched)
    train_metrics = resolve_metrics(
        [*cfg.render_metrics_train, *watched],
        inspector,
        recorded.names,
        key="render_metrics_train",
        algorithm_name=name,
        absent=recorded.absent,
        hint=lambda metric: how_to_declare(type(inspector.algorithm), metric),
    )
    return train_metrics, of_evaluation("render_metrics_test", [*cfg.render_metrics_test, *watched])


def default_metrics(inspector: AgentInspector) -> list[str]:
    """Return the most informative metrics that an algorithm supports."""
    possible = answerable(inspector)
    chosen = (next((name for name in row if name in possible), None) for row in _DEFAULT_METRICS)
    return [name for name in chosen if name is not None]


def film_first_episode(
    env: VecEnv, algorithm: Algorithm, metrics: Sequence[str], clip: ClipInfo, folder: Path
) -> tuple[Timeline, ClipRecorder]:
    """Prepare to record the next episode of a policy that only acts.

    Args:
        env: Its environment.
        algorithm: The algorithm.
        metrics: Metrics to draw.
        clip: What the recording is about; frame rate and panels are filled in.
        folder: Where the files go.

    Returns:
        The timeline and its recorder; the caller must close both.
    """
    leave_out_impossible_pictures(env)
    inspector, observed = AgentInspector(algorithm), observed_layer(env)
    shown = resolve_metrics(metrics, inspector, (), key="--metrics", algorithm_name=clip.algorithm)
    about = replace(clip, fps=frames_per_second(observed), panels=shown.names)
    recorder = ClipRecorder(folder)
    timeline = Timeline(observed, inspector, shown, lambda epoch, episode: about, [recorder])
    timeline.show(clip.epoch)
    return timeline, recorder


def leave_out_impossible_pictures(env: VecEnv, *others: VecEnv) -> None:
    """Tell environments to render nothing where OpenGL is missing: asking it may end the process.

    Args:
        env: One that lives in this process.
        others: Those of the same task.
    """
    from scilab_rl.recording.gl import choose_backend

    envs = getattr(observed_layer(env).venv, "envs", [])
    if not envs or simulator_state(envs[0]) is None:
        return  # only MuJoCo needs OpenGL
    try:
        choose_backend()
    except RenderingError as error:
        for blind in (env, *others):
            blind.env_method("leave_out_pictures", str(error).rstrip("."))


def frames_per_second(env: ObservedVecEnv) -> float:
    """Return the frame rate at which an environment's time is real time."""
    return frame_rate(env.get_attr("metadata", indices=[0])[0])


def _refuse_recorded(
    key: str, names: Sequence[str], inspector: AgentInspector, recorded: Collection[str]
) -> None:
    """Reject for evaluation what the algorithm records only while it learns; name the probe."""
    possible = answerable(inspector)
    for name in names:
        if is_known(name) or not is_recorded(name, recorded):
            continue
        # train/target_critic_variance is near to the probe critic_variance.
        near = [probe for probe in possible if name.endswith(probe)]
        wanted = f"'{max(near, key=len)}'" if near else f"one of {', '.join(possible)}"
        raise ConfigError(
            f"{key}: '{name}' is recorded while the algorithm learns, and in an "
            f"evaluation it does not learn. Use a probe, which is computed for the very step that "
            f"is shown: {wanted}."
        )


def _clip_namer(
    cfg: RunConfig, env: ObservedVecEnv, panels: tuple[str, ...], run: str, algorithm: Algorithm
) -> Callable[[int, int], ClipInfo]:
    """Return the function that says what the clip of an epoch and episode is about."""
    fps = frames_per_second(env)

    def clip(epoch: int, episode: int) -> ClipInfo:
        name = f"{env.phase}_epoch_{epoch:04d}_episode_{episode:05d}"
        policy = f"after {algorithm.num_timesteps:,} steps"
        return ClipInfo(
            name, env.phase, epoch, cfg.env, cfg.algorithm.name, fps, panels, run, cfg.seed, policy
        )

    return clip


def _make_sink(
    cfg: RunConfig,
    panels: tuple[str, ...],
    trigger: Trigger | None,
    folder: Path,
    on_file: Callable[[Path], object],
) -> RecordSink:
    if cfg.render == DISPLAY:
        from scilab_rl.recording.live import LiveViewer

        return LiveViewer(panels, host=cfg.viewer_host)
    from scilab_rl.recording.recorder import ClipRecorder

    def give_to_trackers(path: Path) -> None:
        if path.suffix in _FOR_TRACKERS:
            on_file(path)

    recorder = ClipRecorder(folder / FOLDER, give_to_trackers)
    if trigger is None:
        return recorder
    from scilab_rl.recording.highlights import HighlightRecorder

    return HighlightRecorder(recorder, trigger, give_to_trackers)
