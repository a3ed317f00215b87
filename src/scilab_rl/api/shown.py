"""What a notebook shows: pages in a frame, pictures as pictures."""

from __future__ import annotations

import html
from pathlib import Path


class Page:
    """An HTML file that a notebook shows in a frame.

    Args:
        path: The file, which needs no other file.
        height: Of the frame, in pixels.
    """

    def __init__(self, path: Path, height: int = 620) -> None:
        self.path = path
        self.height = height

    def __repr__(self) -> str:
        return f"{type(self).__name__}('{self.path}')"

    def _repr_html_(self) -> str:
        return in_frame(self.path.read_text(encoding="utf-8"), self.height)


class Replay(Page):
    """A recorded episode: scene and curves, step by step.

    Attributes:
        path: The page, which needs no other file.
    """

    @property
    def video(self) -> Path:
        """The same as a video; it does not exist where no frame can be drawn."""
        return self.path.with_suffix(".mp4")

    @property
    def recording(self) -> Path:
        """Everything that was recorded, see `scilab_rl.recording.records.load_clip`."""
        return self.path.with_suffix(".npz")


def in_frame(page: str, height: int) -> str:
    """Return a page as a frame of another page, which neither style nor script can leave."""
    return (
        f'<iframe srcdoc="{html.escape(page)}" width="100%" height="{height}" '
        'style="border: 0" sandbox="allow-scripts"></iframe>'
    )
