"""Writing mp4 files that stay playable when the program is killed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

_EVEN = 2  # H.264 needs even sides


class VideoWriter:
    """Encodes frames as they come.

    Args:
        path: The mp4 file.
        fps: Frames per second.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path = path
        self.fps = fps
        self.n_frames = 0
        self._encoder: Any = None

    def add(self, frame: np.ndarray) -> None:
        """Add a frame.

        Shapes:
            frame: ``(height, width, 3)``, uint8.

        Raises:
            OSError: If the encoder does not take it.
        """
        if self._encoder is None:
            self._encoder = self._open(frame.shape[1], frame.shape[0])
        height, width = (side - side % _EVEN for side in frame.shape[:2])
        try:
            self._encoder.send(np.ascontiguousarray(frame[:height, :width]))
        except OSError as error:  # it holds the whole command, and what ffmpeg has said at its end
            said = str(error).partition("STDERR OUTPUT:")[2].strip().rpartition("\n")[2]
            reason = f": {said}" if said else ""
            raise OSError(f"ffmpeg ended before the video did{reason}") from error
        self.n_frames += 1

    def close(self) -> None:
        """Finish the file."""
        if self._encoder is not None:
            self._encoder.close()
            self._encoder = None

    def _open(self, width: int, height: int) -> Any:
        import imageio_ffmpeg

        encoder = imageio_ffmpeg.write_frames(
            str(self.path),
            (width - width % _EVEN, height - height % _EVEN),
            fps=self.fps,
            macro_block_size=_EVEN,
            output_params=["-movflags", "+frag_keyframe+empty_moov", "-crf", "23"],
        )
        encoder.send(None)
        return encoder
