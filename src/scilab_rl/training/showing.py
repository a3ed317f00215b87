"""Which episodes are shown, and where: every few epochs, one of training and some of evaluation."""

from __future__ import annotations

import fnmatch
import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.algorithms.inspection import Inspection, recorded_names
from scilab_rl.envs.frames import simulator_state
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import ConfigError, RenderingError
from scilab_rl.metrics.probes import ShownMetrics, answerable, is_known, resolve_metrics
from scilab_rl.metrics.triggers import Trigger, parse_trigger
from scilab_rl.training.timeline import RecordSink, Timeline
from scilab_rl.training.trainer import Trainer
from scilab_rl.visualization.archive import FOLDER
from scilab_rl.visualization.records import ClipInfo

_log = logging.getLogger(__name__)
DEFAULT_FPS = 25.0
RECORD, DISPLAY = "record", "display"
_FOR_TRACKERS = (".mp4", ".html")


@dataclass(frozen=True)
class ShowingPlan:
    """What the configuration says about showing.

    Attributes:
        render: ``record``, ``display``, or anything else: nothing is shown.
        render_freq: Epochs between shown ones; the first one is always shown.
        render_frames_per_clip: Scenes of a clip; 0: one episode.
        record_when: Condition of the moments that are kept, instead of whole clips.
        render_metrics_train: Metrics beside training episodes.
        render_metrics_test: Metrics beside evaluation episodes.
        n_test_rollouts: Evaluation episodes per epoch.
        viewer_host: Address that the live view listens on.
        env_id: Id of the environment.
        algorithm: Name of the algorithm.
    """

    render: str
    render_freq: int
    render_frames_per_clip: int
    record_when: str | None
    render_metrics_train: Sequence[str]
    render_metrics_test: Sequence[str]
    n_test_rollouts: int
    viewer_host: str
    env_id: str
    algorithm: str

    @property
    def needs_frames(self) -> bool:
        """Whether environments must be able to draw."""
        return self.render in (RECORD, DISPLAY)

    def describe(self, phase: str, panels: tuple[str, ...], fps: float) -> Any:
        """Return the function that says what a clip of this phase is about."""

        def clip(epoch: int, episode: int) -> ClipInfo:
            name = f"{phase}_epoch_{epoch:04d}_episode_{episode:05d}"
            return ClipInfo(name, phase, epoch, self.env_id, self.algorithm, fps, panels)

        return clip


class Showing:
    """Tells the timelines when to show something.

    Args:
        trainer: The training.
        render_freq: Epochs between shown ones.
        train: Timeline of the training environments.
        evaluation: Timeline of the environment for evaluation.
        n_eval_clips: How many episodes of a shown evaluation are shown.
        sinks: Closed at the end.
    """

    def __init__(
        self,
        trainer: Trainer,
        render_freq: int = 1,
        *,
        train: Timeline | None = None,
        evaluation: Timeline | None = None,
        n_eval_clips: int = 1,
        sinks: Sequence[Any] = (),
    ) -> None:
        self.trainer = trainer
        self.render_freq = render_freq
        self.train = train
        self.evaluation = evaluation
        self.n_eval_clips = n_eval_clips
        self.sinks = sinks
        if train is not None:
            trainer.after_step.append(self._after_step)
            trainer.before_evaluation.append(self._before_evaluation)

    def begin(self) -> None:
        """Get ready for the first epoch; called before the environments are reset."""
        self._show_training(self.trainer.n_epochs_done + 1)

    def close(self) -> None:
        """Finish what is being shown and wait until it is written."""
        for timeline in (self.train, self.evaluation):
            if timeline is not None:
                timeline.close()
        for sink in self.sinks:
            sink.close()

    def _is_shown(self, epoch: int) -> bool:
        return epoch == 1 or epoch % self.render_freq == 0

    def _show_training(self, epoch: int) -> None:
        if self.train is not None and self._is_shown(epoch):
            self.train.show(epoch)

    def _before_evaluation(self, epoch: int) -> None:
        if self.evaluation is not None and self._is_shown(epoch):
            self.evaluation.show(epoch, self.n_eval_clips)
        self._show_training(epoch + 1)

    def _after_step(self) -> None:
        assert self.train is not None and self.evaluation is not None
        self.evaluation.close()  # nothing of an evaluation goes on after it
        self.train.complete_step()


def make_showing(
    plan: ShowingPlan, trainer: Trainer, train_env: VecEnv, algorithm: Any, folder: Path
) -> Showing:
    """Join environments, algorithm and what shows them.

    Args:
        plan: What is shown.
        trainer: The training; its trackers get videos and pages.
        train_env: The training environments.
        algorithm: The algorithm.
        folder: Directory of the run.

    Raises:
        ConfigError: If a metric is unknown or the algorithm cannot answer it.
        MissingDependencyError: If the live view is not installed.
    """
    if not plan.needs_frames:
        return Showing(trainer)
    mind, who = Inspection(algorithm), plan.algorithm
    trigger = parse_trigger(plan.record_when) if plan.record_when else None
    watched = [trigger.metric] if trigger is not None and trigger.metric else []
    train_metrics = resolve_metrics(
        [*plan.render_metrics_train, *watched],
        mind,
        recorded_names(algorithm),
        key="render_metrics_train",
        who=who,
    )
    _refuse_recorded(plan.render_metrics_test, mind, recorded_names(algorithm))
    test_metrics = resolve_metrics(
        [*plan.render_metrics_test, *watched], mind, (), key="render_metrics_test", who=who
    )
    if not can_draw(trainer.eval_env):
        return Showing(trainer)
    panels = tuple(dict.fromkeys(train_metrics.names + test_metrics.names))
    sinks = [_make_sink(plan, panels, trigger, folder, trainer.trackers.artifact)]

    def timeline(env: ObservedVecEnv, metrics: ShownMetrics, logger: Any = None) -> Timeline:
        return Timeline(
            env,
            mind,
            metrics,
            plan.describe(env.phase, metrics.names, frames_per_second(env)),
            sinks,
            frames_per_clip=plan.render_frames_per_clip,
            logger=logger,
        )

    return Showing(
        trainer,
        plan.render_freq,
        train=timeline(observed_layer(train_env), train_metrics, trainer.metric_logger),
        evaluation=timeline(observed_layer(trainer.eval_env), test_metrics),
        n_eval_clips=plan.n_test_rollouts if plan.render == DISPLAY or trigger else 1,
        sinks=sinks,
    )


def film_first_episode(
    env: VecEnv, algorithm: Any, metrics: Sequence[str], clip: ClipInfo, folder: Path
) -> tuple[Timeline, Any]:
    """Prepare to record the next episode of a policy that only acts.

    Args:
        env: Its environment.
        algorithm: The algorithm.
        metrics: Metrics to draw.
        clip: What the recording is about; frame rate and panels are filled in.
        folder: Where the files go.

    Returns:
        The timeline and its recorder; both want to be closed.
    """
    from scilab_rl.visualization.recorder import ClipRecorder

    mind, observed = Inspection(algorithm), observed_layer(env)
    shown = resolve_metrics(metrics, mind, (), key="--metrics", who=clip.algorithm)
    about = replace(clip, fps=frames_per_second(observed), panels=shown.names)
    recorder = ClipRecorder(folder)
    timeline = Timeline(observed, mind, shown, lambda epoch, episode: about, [recorder])
    timeline.show(clip.epoch)
    return timeline, recorder


def can_draw(env: VecEnv) -> bool:
    """Tell whether pictures of an environment can be drawn here; say so if not."""
    from scilab_rl.visualization.gl import choose_backend

    envs = getattr(observed_layer(env).venv, "envs", [])
    if not envs or simulator_state(envs[0]) is None:
        return True  # only MuJoCo needs OpenGL
    try:
        choose_backend()
    except RenderingError as error:
        _log.warning("%s Nothing is shown; training goes on.", error)
        return False
    return True


def frames_per_second(env: ObservedVecEnv) -> float:
    """Return the frame rate at which an environment's time is real time."""
    return float(env.get_attr("metadata", indices=[0])[0].get("render_fps") or DEFAULT_FPS)


def _refuse_recorded(names: Sequence[str], mind: Inspection, recorded: Collection[str]) -> None:
    """Refuse for evaluation what the algorithm records only while it learns; name the probe."""
    possible = answerable(mind)
    for name in names:
        is_recorded = any(fnmatch.fnmatchcase(name, pattern) for pattern in recorded)
        if not is_recorded or is_known(name):
            continue
        probe = name.rpartition("/")[2]
        wanted = f"'{probe}'" if probe in possible else f"one of {', '.join(possible)}"
        raise ConfigError(
            f"render_metrics_test: '{name}' is recorded while the algorithm learns, and in an "
            f"evaluation it does not learn. Use a probe, which is computed for the very step that "
            f"is shown: {wanted}."
        )


def _make_sink(
    plan: ShowingPlan,
    panels: tuple[str, ...],
    trigger: Trigger | None,
    folder: Path,
    on_file: Callable[[Path], object],
) -> RecordSink:
    if plan.render == DISPLAY:
        from scilab_rl.visualization.live import LiveViewer

        return LiveViewer(panels, host=plan.viewer_host)
    from scilab_rl.visualization.recorder import ClipRecorder

    def give_to_trackers(path: Path) -> None:
        if path.suffix in _FOR_TRACKERS:
            on_file(path)

    recorder = ClipRecorder(folder / FOLDER, give_to_trackers)
    if trigger is None:
        return recorder
    from scilab_rl.visualization.gallery import MomentRecorder

    return MomentRecorder(recorder, trigger, give_to_trackers)
