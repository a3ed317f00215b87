"""Recording one episode of a vector environment as a video."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from scilab_rl.envs.observed import ObservedVecEnv, StepBatch
from scilab_rl.visualization.video import VideoWriter

_log = logging.getLogger(__name__)
DEFAULT_FPS = 25.0


class EpisodeRecorder:
    """Films the next episode of environment 0 whenever it is armed.

    A frame that cannot be drawn or written ends the filming with one warning, never the run.

    Args:
        env: The environments; made with ``render_mode="rgb_array"``.
        on_video: Called with the path of each finished video.
    """

    def __init__(
        self, env: ObservedVecEnv, on_video: Callable[[Path], object] | None = None
    ) -> None:
        self.env = env
        self.on_video = on_video
        self.fps = float(env.get_attr("metadata")[0].get("render_fps") or DEFAULT_FPS)
        self._writer: VideoWriter | None = None
        env.observers.append(self)

    def arm(self, path: Path) -> None:
        """Film the next episode into this file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = VideoWriter(path, self.fps)
        self.env.env_method("capture_frames", True)

    def on_step(self, batch: StepBatch) -> None:
        """Add the frame of this step."""
        if self._writer is None:
            return
        try:
            if batch.episode_steps[0] == 0 and self.env.reset_frame is not None:
                self._writer.add(self.env.reset_frame)
            frame = batch.frames[0]
            if frame is not None:
                self._writer.add(frame)
            if batch.dones[0]:
                self._finish()
        except (OSError, RuntimeError, ValueError) as error:
            _log.warning("Recording stopped: %s. Training goes on.", error)
            self._writer = None

    def _finish(self) -> None:
        assert self._writer is not None
        self._writer.close()
        self.env.env_method("capture_frames", False)
        path, self._writer = self._writer.path, None
        if self.on_video is not None:
            self.on_video(path)
