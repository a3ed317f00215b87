"""The paper's figure as a video: the scene on the left, the curves up to now on the right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.visualization.panels import (
    BACKGROUND,
    FAINT,
    INK,
    PanelSheet,
    _font,
    sheet_height,
)
from scilab_rl.visualization.records import Clip, Record, decode_picture
from scilab_rl.visualization.video import VideoWriter

SCENE_BOX = (640, 480)  # pixels; the scene keeps its shape inside
COLUMN = 320  # pixels of a column of panels
HEADER = 32
_SMALL = 200
PHASES = {"train": "training", "eval": "evaluation"}


def write_movie(clip: Clip, path: Path) -> None:
    """Write a clip as mp4.

    Raises:
        OSError: If not all frames are in the file, for example because the disk is full.
    """
    import imageio_ffmpeg

    writer, frames = VideoWriter(path, clip.info.fps), MovieFrames(clip)
    try:
        for index in range(len(frames)):
            writer.add(frames[index])
    finally:
        writer.close()
    try:
        n_written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))  # the encoder hides failures
    except RuntimeError:  # it cannot even be opened; the message is all that ffmpeg has to say
        n_written = 0
    if n_written != len(frames):
        raise OSError(f"{n_written} of {len(frames)} frames could be written; is the disk full?")


class MovieFrames:
    """The frames of a video, one per scene.

    Args:
        clip: The finished clip.
    """

    def __init__(self, clip: Clip) -> None:
        self.clip = clip
        height, width = decode_picture(clip.records[0].picture).shape[:2]
        scale = min(SCENE_BOX[0] / width, SCENE_BOX[1] / height)
        self.scene_size = (round(width * scale), round(height * scale))
        n_panels = len(clip.info.panels)
        content = sheet_height(n_panels, SCENE_BOX[1]) if n_panels else SCENE_BOX[1]
        self.sheet = PanelSheet(clip, COLUMN, content) if n_panels else None
        sheet_width = self.sheet.size[0] if self.sheet else 0
        self.size = (_even(self.scene_size[0] + sheet_width), _even(HEADER + content))
        self.scene_corner = (0, HEADER + (content - self.scene_size[1]) // 2)

    def __len__(self) -> int:
        return len(self.clip.records)

    def __getitem__(self, index: int) -> np.ndarray:
        """Return the frame of a scene. Shapes: ``(height, width, 3)``, uint8."""
        from PIL import Image, ImageDraw

        record = self.clip.records[index]
        image = Image.new("RGB", self.size, BACKGROUND)
        image.paste(self._scene(record), self.scene_corner)
        if self.sheet is not None:
            image.paste(self.sheet.until(index), (self.scene_size[0], HEADER))
        self._write_header(ImageDraw.Draw(image), record)
        return np.asarray(image)

    def _scene(self, record: Record) -> Any:
        from PIL import Image

        scene = Image.fromarray(decode_picture(record.picture))
        if scene.size == self.scene_size:
            return scene
        is_small = max(scene.size) <= _SMALL
        how = Image.Resampling.NEAREST if is_small else Image.Resampling.LANCZOS
        return scene.resize(self.scene_size, how)

    def _write_header(self, draw: Any, record: Record) -> None:
        info, font = self.clip.info, _font(14)
        draw.text((12, 9), f"{info.env_id}  {info.algorithm}", fill=INK, font=font)
        used = 12 + draw.textlength(f"{info.env_id}  {info.algorithm}", font=font)
        where = (
            f"{PHASES.get(info.phase, info.phase)}, epoch {info.epoch}, "
            f"episode {record.episode}, step {record.step}"
        )
        draw.text((used + 16, 9), where, fill=FAINT, font=font)
        events = ", ".join(event for event in record.events if event != "episode start")
        if events and self.size[0] > self.scene_size[0]:
            draw.text((self.size[0] - 12, 9), events, fill="#dc2626", font=font, anchor="ra")


def _even(side: int) -> int:
    return side + side % 2  # H.264 needs even sides
