"""What a notebook shows: pages in a frame, pictures as pictures."""

from __future__ import annotations

import html
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.drawing import COLORS
from scilab_rl.files import atomic_write

if TYPE_CHECKING:  # heavy
    import matplotlib.figure


class Page:
    """An HTML file that a notebook shows in a frame.

    Args:
        path: The file, which needs no other file.
        height: Of the frame, in pixels.
    """

    def __init__(self, path: Path, height: int = 900) -> None:
        self.path = path
        self.height = height

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.path.name}>"

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


class Figure:
    """A picture that a notebook shows.

    Args:
        figure: Matplotlib's figure.

    Attributes:
        figure: The same, to be changed.
    """

    def __init__(self, figure: matplotlib.figure.Figure) -> None:
        self.figure = figure

    def __repr__(self) -> str:
        labels = (str(line.get_label()) for axes in self.figure.axes for line in axes.lines)
        return f"<Figure of {', '.join(labels)}>"

    @classmethod
    def of_curves(cls, curves: Mapping[str, Sequence[tuple[float, float]]]) -> Figure:
        """Draw curves over environment steps.

        Args:
            curves: Label to the points of a curve.
        """
        from matplotlib.figure import Figure as MatplotlibFigure

        figure = MatplotlibFigure(figsize=(6.4, 3.2), dpi=120, layout="constrained")
        axes = figure.subplots()
        axes.spines[["top", "right"]].set_visible(False)
        for index, (label, points) in enumerate(curves.items()):
            axes.plot(
                *zip(*points, strict=True), ".-", color=COLORS[index % len(COLORS)], label=label
            )
        axes.set_xlabel("environment steps")
        if len(curves) == 1:
            axes.set_ylabel(next(iter(curves)))
        else:
            axes.legend()
        return cls(figure)

    def save(self, path: str | Path) -> Path:
        """Write it as PNG, SVG or PDF, by the suffix of the path."""
        path = Path(path)
        atomic_write(path, lambda file: self.figure.savefig(file, format=path.suffix[1:]))
        return path

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.figure.savefig(picture, format="png")
        return picture.getvalue()


def in_notebook() -> bool:
    """Return whether a notebook runs this program."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def table_html(facts: Mapping[str, object]) -> str:
    """Return facts as a table of two columns."""
    rows = (
        f"<tr><th style='text-align: left'>{html.escape(name)}</th>"
        f"<td style='text-align: left'>{html.escape(_text(value))}</td></tr>"
        for name, value in facts.items()
    )
    return f"<table>{''.join(rows)}</table>"


def _text(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
