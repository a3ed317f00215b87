"""The one place where frames and metrics are joined: by phase, environment, episode and step."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.scenes import start_as_text
from scilab_rl.envs.vec_step import ObservedStep
from scilab_rl.errors import did_you_mean
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.learning.observations import single
from scilab_rl.metrics.events import EpisodeEvents
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.probes import Curve, EpisodeProbes, ShownMetrics
from scilab_rl.metrics.success import success_of
from scilab_rl.recording.records import ClipInfo, Record, encode_picture

_log = logging.getLogger(__name__)
_SIMULATORS = ("model", "sim")  # MuJoCo's; PyBullet's and CoppeliaSim's
_ENV = 0  # the environment that is shown
NO_PICTURE = "Scenes without picture: %s. Their numbers and curves are recorded without it."


class RecordSink(Protocol):
    """Somebody who shows or keeps records."""

    def begin(self, clip: ClipInfo) -> None:
        """Begin a clip."""

    def add(self, record: Record) -> None:
        """Take the next scene."""

    def end(self) -> None:
        """Finish the clip."""

    def close(self) -> None:
        """Wait until all is shown or written."""


class Timeline:
    """Observes the steps of an environment and makes a record of each scene that is shown.

    Steps that are not watched cost one comparison. `records` says which numbers belong to
    which frame. Nothing that goes wrong here ends the training.

    Args:
        env: The environments; made with ``render_mode="rgb_array"``.
        inspector: The algorithm.
        metrics: What is shown.
        describe: Returns what a clip is about, given its epoch and first episode.
        sinks: Where the records go.
        frames_per_clip: Scenes of a clip, over as many episodes as it takes; 0: one episode.
        logger: What the algorithm records to. With a logger, a step is complete only when
            `complete_step` says so, because algorithms record also after ``env.step``.
        warned: What has been said already; timelines that share it say nothing twice.
    """

    def __init__(
        self,
        env: ObservedVecEnv,
        inspector: AgentInspector,
        metrics: ShownMetrics,
        describe: Callable[[int, int], ClipInfo],
        sinks: Sequence[RecordSink],
        *,
        frames_per_clip: int = 0,
        logger: MetricLogger | None = None,
        warned: set[str] | None = None,
    ) -> None:
        self.env = env
        self.inspector = inspector
        self.metrics = metrics
        self.describe = describe
        self.sinks = list(sinks)
        self.frames_per_clip = frames_per_clip
        self.logger = logger
        self._clips_wanted = 0
        self._epoch = 0
        self._n_scenes: int | None = None  # of the running clip; None between clips
        self._scene: tuple[np.ndarray | str | None, np.ndarray | None] = (None, None)
        self._last_success: bool | None = None
        self._pending: list[Record] = []
        self._warned: set[str] = set() if warned is None else warned
        env.observers.append(self)

    def show(self, epoch: int, n_clips: int = 1) -> None:
        """Show the next clips, from the next episode on.

        Args:
            epoch: Number of the epoch, from 1.
            n_clips: How many; those of an earlier call that have not begun are dropped.
        """
        self._epoch = epoch
        if self._n_scenes is not None or not self.sinks:
            return
        self._clips_wanted = n_clips
        self.env.env_method("capture_frames", True, indices=[_ENV])
        if self.logger is not None:
            self.logger.watch(self.metrics.recorded)

    def on_step(self, step: ObservedStep) -> None:
        """Make the record of this step, if it is shown."""
        if not self._clips_wanted:
            return
        self._send_pending()  # of an algorithm that does not say when a step is complete
        if step.episode_steps[_ENV] == 0:
            self._begin_episode(step)
        if self._n_scenes is None:
            return
        with self.inspector.undisturbed():
            self._add_scenes(step)
        if self.logger is None:
            self.complete_step()

    def complete_step(self) -> None:
        """Respond to the end of the last step: everything that belongs to it is recorded."""
        if not self._clips_wanted:
            return
        seen = self.logger.take_seen() if self.logger is not None else {}
        if self._pending:
            self._pending[0].values |= {Curve(name): value for name, value in seen.items()}
            self._send_pending()

    def close(self) -> None:
        """Finish the clip that is running, if any."""
        self.complete_step()
        if self._n_scenes is not None:
            self._end_clip()

    def _begin_episode(self, step: ObservedStep) -> None:
        self._scene = (self.env.reset_frame, self.env.reset_state)
        if self._scene[0] is None and self._n_scenes is None:  # captured from the next reset on
            return
        self._probes = EpisodeProbes(self.inspector, self.metrics.probes, self._warn_once)
        in_space = any(self.env.has_attr(name) for name in _SIMULATORS)
        self._events = EpisodeEvents(in_space=in_space)
        self._last_success = None
        if self._n_scenes is None:
            self._n_scenes = 0
            clip = self.describe(self._epoch, int(step.episodes[_ENV]))
            self._tell("begin", clip)

    def _add_scenes(self, step: ObservedStep) -> None:
        self._pending = [self._record(step)]
        self._scene = (step.frames[_ENV], step.states[_ENV])
        if step.dones[_ENV]:
            self._pending.append(self._last_scene(step))

    def _record(self, step: ObservedStep) -> Record:
        frame, state = self._scene
        done, terminated = bool(step.dones[_ENV]), bool(step.terminated[_ENV])
        observation, next_observation = (
            single(step.observations, _ENV),
            single(step.next_observations, _ENV),
        )
        info = step.infos[_ENV]
        action, reward = np.array(step.actions[_ENV]), float(step.rewards[_ENV])
        record = Record(
            step.phase,
            _ENV,
            int(step.episodes[_ENV]),
            int(step.episode_steps[_ENV]),
            step.step - self.env.num_envs,
            self._picture(frame),
            observation,
            action,
            reward,
            terminated,
            bool(step.truncated[_ENV]),
            success_of(info),
            state,
            self._probes.of_step(
                observation, action, reward, next_observation, info, done, terminated
            ),
            self._events.of_scene(observation, self._last_success),
            self._start_of_episode(step),
        )
        self._last_success = record.success
        return record

    def _start_of_episode(self, step: ObservedStep) -> str:
        start = self.env.episode_start
        return "" if start is None or step.episode_steps[_ENV] else start_as_text(start)

    def _last_scene(self, step: ObservedStep) -> Record:
        frame, state = self._scene
        observation = single(step.next_observations, _ENV)
        return Record(
            step.phase,
            _ENV,
            int(step.episodes[_ENV]),
            int(step.episode_steps[_ENV]) + 1,
            step.step,
            self._picture(frame),
            observation,
            state=state,
            values=self._probes.of_scene(observation),
            events=self._events.of_scene(observation, self._last_success),
        )

    def _send_pending(self) -> None:
        records, self._pending = self._pending, []
        for record in records:
            self._send(record)
        if records and self._n_scenes is not None and self._clip_is_full(records[-1]):
            self._end_clip()

    def _clip_is_full(self, last: Record) -> bool:
        if self.frames_per_clip:
            return (self._n_scenes or 0) >= self.frames_per_clip
        return last.is_last_scene

    def _send(self, record: Record) -> None:
        if self._n_scenes is None or (
            self.frames_per_clip and self._n_scenes >= self.frames_per_clip
        ):
            return
        self._n_scenes += 1
        self._tell("add", record)

    def _end_clip(self) -> None:
        self._n_scenes = None
        self._clips_wanted -= 1
        self._tell("end")
        self._warn_of_mistyped_names()
        if not self._clips_wanted:
            self.env.env_method("capture_frames", False, indices=[_ENV])
            if self.logger is not None:
                self.logger.watch(())

    def _warn_of_mistyped_names(self) -> None:
        known = self.logger.name_to_value if self.logger is not None else {}
        for name in self.metrics.recorded:
            if name not in known and (suggestion := did_you_mean(name, known)):
                self._warn_once(f"'{name}' has not been recorded: its panel is empty.{suggestion}")

    def _picture(self, frame: np.ndarray | str | None) -> bytes:
        """Return the picture of a frame; of one that could not be drawn, none."""
        if isinstance(frame, np.ndarray):
            return encode_picture(frame)
        if NO_PICTURE not in self._warned:
            self._warned.add(NO_PICTURE)
            _log.warning(NO_PICTURE, frame or "a step gave no frame")
        return b""

    def _tell(self, what: str, *arguments: object) -> None:
        for sink in list(self.sinks):
            try:
                getattr(sink, what)(*arguments)
            except Exception as error:  # noqa: BLE001 - showing must not end the training
                self.sinks.remove(sink)
                self._warn_once(
                    f"{type(sink).__name__} is switched off: {type(error).__name__}: {error}. "
                    "Training continues."
                )

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            _log.warning(message)
