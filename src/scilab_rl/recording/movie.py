"""The paper's figure as a video: the scene on the left, the curves up to now on the right.

All that does not move is drawn once per clip and then uncovered step by step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.drawing import (
    BACKGROUND,
    COLORS,
    FAILED,
    FAINT,
    FRAME,
    GRID,
    INK,
    REACHED,
    font,
    number_text,
    ticks,
)
from scilab_rl.recording.records import (
    Clip,
    Record,
    decode_picture,
    picture_size,
    title_of,
    value_range,
)

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SCENE_BOX = (640, 480)  # pixels; the scene keeps its shape inside
CARD = 360  # pixels, of a card's width and its scene's height
COLUMN = 320  # pixels of a column of panels
HEADER = 32
_SMALL = 200
_EVEN = 2  # H.264 needs even sides
_ROWS = 4  # panels in one column, until there are four columns
_MIN_PANEL_HEIGHT = 112
NO_VALUE = "-"  # the font has no dash
_SMOOTH = 2  # everything that does not move is drawn twice as large and scaled down
WENT_WRONG = ("fell", "lost")  # words of events
_HELD = 1.5  # seconds; the last frame stays, because players start again at once
_TITLE, _LEFT, _RIGHT, _BOTTOM = 22, 50, 12, 18  # pixels around the curves


def write_movie(clip: Clip, path: Path) -> None:
    """Write a clip as mp4, which stays playable when the program is killed.

    It runs in real time, or slower if the clip is short, and ends with a still picture.

    Raises:
        OSError: If not all frames are in the file, for example because the disk is full.
    """
    frames = MovieFrames(clip)
    shown = [*range(len(frames)), *[len(frames) - 1] * n_held(clip)]
    encode((frames[index] for index in shown), frames.size, clip.shown_rate, path)


def write_side_by_side(
    clips: Sequence[Clip], titles: Sequence[str], panel: str, path: Path
) -> None:
    """Write several clips as one mp4, next to each other: scene, title and one curve of each.

    A clip that ends first stays at its last scene.

    Args:
        clips: At least one.
        titles: Written above each.
        panel: The metric whose curve is drawn.
        path: Of the video.

    Raises:
        OSError: If not all frames are in the file.
    """
    curves = [curve for clip in clips for curve in clip.curves(panel).values()]
    cards = [
        CardFrames(clip, panel, title, value_range(curves))
        for clip, title in zip(clips, titles, strict=True)
    ]
    n_frames = max(map(len, cards))
    places = [*range(n_frames), *[n_frames - 1] * n_held(clips[0])]
    frames = (
        np.concatenate([np.asarray(card[min(place, len(card) - 1)]) for card in cards], axis=1)
        for place in places
    )
    width, height = cards[0].size
    encode(frames, (width * len(cards), height), clips[0].shown_rate, path)


def encode(frames: Iterable[np.ndarray], size: tuple[int, int], rate: float, path: Path) -> None:
    """Write frames as mp4.

    Args:
        frames: All of one size. Shapes: each ``(height, width, 3)``, uint8.
        size: Width and height in pixels, both even.
        rate: Frames per second.
        path: Of the video.

    Raises:
        OSError: If not all frames are in the file.
    """
    import imageio_ffmpeg

    encoder = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=rate,
        macro_block_size=_EVEN,
        output_params=["-movflags", "+frag_keyframe+empty_moov", "-crf", "23"],
    )
    encoder.send(None)
    n_frames = 0
    try:
        for frame in frames:
            encoder.send(np.ascontiguousarray(frame))
            n_frames += 1
    except OSError as error:  # it holds the whole command, and what ffmpeg has said at its end
        said = str(error).partition("STDERR OUTPUT:")[2].strip().rpartition("\n")[2]
        reason = f": {said}" if said else ""
        raise OSError(f"ffmpeg ended before the video did{reason}") from error
    finally:
        encoder.close()
    try:
        n_written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))  # the encoder hides failures
    except RuntimeError:  # it cannot even be opened; the message is all that ffmpeg has to say
        n_written = 0
    if n_written != n_frames:
        raise OSError(f"{n_written} of {n_frames} frames could be written; is the disk full?")


def n_held(clip: Clip) -> int:
    """Return how many times the last frame of a video is repeated."""
    return round(_HELD * clip.shown_rate)


class MovieFrames:
    """The frames of a video, one per scene.

    Args:
        clip: The finished clip.
    """

    def __init__(self, clip: Clip) -> None:
        self.clip = clip
        sizes = [picture_size(record.picture) for record in clip.records if record.picture]
        # One scale for the whole clip, so that a frame that grows is seen to grow.
        width, height = np.max(sizes, axis=0) if sizes else (0, 0)
        self.scale = min(SCENE_BOX[0] / width, SCENE_BOX[1] / height) if sizes else 1.0
        self.scene_size = self._scaled(width, height) if sizes else (0, 0)
        n_panels = len(clip.info.panels)
        content = sheet_height(n_panels, SCENE_BOX[1]) if n_panels else SCENE_BOX[1]
        if not n_panels and not sizes:
            self.scene_size = SCENE_BOX  # nothing but the numbers above it
        column = COLUMN if sizes else SCENE_BOX[0]
        self.sheet = PanelSheet(clip, column, content) if n_panels else None
        sheet_width = self.sheet.size[0] if self.sheet else 0
        width, height = self.scene_size[0] + sheet_width, HEADER + content
        self.size = width + width % _EVEN, height + height % _EVEN
        self.scene_corner = (0, HEADER + (content - self.scene_size[1]) // 2)

    def __len__(self) -> int:
        return len(self.clip.records)

    def __getitem__(self, index: int) -> np.ndarray:
        """Return the frame of a scene. Shapes: ``(height, width, 3)``, uint8."""
        from PIL import Image, ImageDraw

        record = self.clip.records[index]
        image = Image.new("RGB", self.size, BACKGROUND)
        if record.picture:
            scene = self._scene(record)
            left, top = ((self.scene_size[i] - scene.size[i]) // 2 for i in (0, 1))
            corner = (self.scene_corner[0] + left, self.scene_corner[1] + top)
            image.paste(scene, corner)
            mark_outcome(ImageDraw.Draw(image), self.clip, index, corner, scene.size)
        if self.sheet is not None:
            image.paste(self.sheet.until(index), (self.scene_size[0], HEADER))
        self._write_header(ImageDraw.Draw(image), record)
        return np.asarray(image)

    def _scene(self, record: Record) -> Image:
        from PIL import Image

        scene = Image.fromarray(decode_picture(record.picture))
        is_small = max(scene.size) <= _SMALL
        how = Image.Resampling.NEAREST if is_small else Image.Resampling.LANCZOS
        size = self._scaled(*scene.size)
        return scene if scene.size == size else scene.resize(size, how)

    def _scaled(self, width: int, height: int) -> tuple[int, int]:
        return max(1, round(width * self.scale)), max(1, round(height * self.scale))

    def _write_header(self, draw: ImageDraw, record: Record) -> None:
        info, letters = self.clip.info, font(14)
        draw.text((12, 9), f"{info.env_id}  {info.algorithm}", fill=INK, font=letters)
        used = 12 + draw.textlength(f"{info.env_id}  {info.algorithm}", font=letters)
        where = f"{info.place(record.episode)}, step {record.step}"
        draw.text((used + 16, 9), where, fill=FAINT, font=letters)
        events = ", ".join(event for event in record.events if event != "episode start")
        if events and self.size[0] > self.scene_size[0]:
            draw.text(
                (self.size[0] - 12, 9), events, fill=event_color(events), font=letters, anchor="ra"
            )


def mark_outcome(
    draw: ImageDraw, clip: Clip, index: int, corner: tuple[int, int], size: tuple[int, int]
) -> None:
    """Frame the scenes after which the task is solved, and the last one of a failure.

    Args:
        draw: Draws into the frame.
        clip: The finished clip.
        index: Of the scene.
        corner: Left and top of the scene in the frame, in pixels.
        size: Its width and height.
    """
    record, reached = clip.records[index], index > 0 and clip.records[index - 1].success
    if record.step == 0 or reached is None or not (reached or record.is_last_scene):
        return
    if not record.picture or max(picture_size(record.picture)) <= _SMALL:
        return  # nothing may be drawn over a picture of few pixels
    color, text = (REACHED, "success") if reached else (FAILED, "no success")
    right, bottom = corner[0] + size[0] - 1, corner[1] + size[1] - 1
    draw.rectangle((*corner, right, bottom), outline=color, width=3)
    width = draw.textlength(text, font=font(14))
    pill = (corner[0] + 12, bottom - 38, corner[0] + 32 + width, bottom - 12)
    draw.rounded_rectangle(pill, 13, fill=color)
    draw.text((corner[0] + 22, bottom - 25), text, fill="#ffffff", font=font(14), anchor="lm")


class CardFrames:
    """The frames of a small picture of a clip: its scene and, below it, one curve.

    Args:
        clip: The finished clip.
        panel: The metric.
        title: Above the scene; empty: none.
        span: The range of the curve's axis; None: that of the clip.
    """

    def __init__(
        self, clip: Clip, panel: str, title: str = "", span: tuple[float, float] | None = None
    ) -> None:
        self.clip = Clip(replace(clip.info, panels=(panel,)), clip.records)
        self.title = title
        self.top = HEADER if title else 0
        self.sheet = PanelSheet(self.clip, CARD, _MIN_PANEL_HEIGHT, span)
        self.size = (CARD, self.top + CARD + _MIN_PANEL_HEIGHT)

    def __len__(self) -> int:
        return len(self.clip.records)

    def __getitem__(self, index: int) -> Image:
        """Return the frame of a scene as a Pillow image."""
        from PIL import Image, ImageDraw

        frame, record = Image.new("RGB", self.size, BACKGROUND), self.clip.records[index]
        if record.picture:
            scene = Image.fromarray(decode_picture(record.picture))
            scale = CARD / max(scene.size)
            scene = scene.resize(
                (round(scene.width * scale), round(scene.height * scale)), Image.Resampling.LANCZOS
            )
            left, top = (CARD - scene.width) // 2, (CARD - scene.height) // 2
            frame.paste(scene, (left, self.top + top))
        frame.paste(self.sheet.until(index), (0, self.top + CARD))
        draw = ImageDraw.Draw(frame)
        draw.text((12, 9), self.title, fill=INK, font=font(14))
        mark_outcome(draw, self.clip, index, (0, self.top), (CARD, CARD))
        return frame


def grid(n_panels: int) -> tuple[int, int]:
    """Return rows and columns for a number of panels; none is left out.

    >>> [grid(n) for n in (1, 3, 4, 5, 7, 9, 11, 16, 20)]
    [(1, 1), (3, 1), (4, 1), (3, 2), (4, 2), (3, 3), (4, 3), (4, 4), (5, 4)]
    """
    columns = min(math.ceil(n_panels / _ROWS), _ROWS)
    return math.ceil(n_panels / columns), columns


def sheet_height(n_panels: int, at_least: int) -> int:
    """Return the height in pixels that the panels need."""
    return max(at_least, grid(n_panels)[0] * _MIN_PANEL_HEIGHT)


@dataclass(frozen=True)
class _Panel:
    """Where a panel lies and what it shows; pixels on the finished sheet."""

    name: str
    curves: dict[str, list[float | None]]
    left: int
    top: int
    right: int
    bottom: int
    low: float
    high: float

    def y(self, number: float) -> float:
        """Return the height of a number on the sheet."""
        share = (number - self.low) / (self.high - self.low)
        return self.bottom - share * (self.bottom - self.top)


class PanelSheet:
    """The panels of a clip, drawn up to any of its scenes.

    Ranges are those of the whole clip, so that nothing jumps.

    Args:
        clip: The finished clip.
        width: Pixels of one column.
        height: Pixels of the sheet.
        span: The range of all axes; None: that of each metric.
    """

    def __init__(
        self, clip: Clip, width: int, height: int, span: tuple[float, float] | None = None
    ) -> None:
        names = clip.info.panels
        rows, columns = grid(len(names))
        self.size = (columns * width, height)
        self.n = len(clip.records)
        self.span = span
        self.breaks = {i for i in range(1, self.n) if clip.records[i].step == 0}
        self.events = [
            (index, event)
            for index, record in enumerate(clip.records)
            for event in record.events
            if event != "episode start"
        ]
        self.panels = [
            self._place(clip, name, index, rows, width) for index, name in enumerate(names)
        ]
        self._empty = self._drawn(with_curves=False)
        self._full = self._drawn(with_curves=True)

    def until(self, index: int) -> Image:
        """Return the sheet as a Pillow image, with curves up to this scene."""
        from PIL import Image, ImageDraw

        pixels = self._empty.copy()
        for panel in self.panels:
            x = round(self._x(panel, index)) + 1
            area = np.s_[panel.top - 4 : panel.bottom + 4, panel.left - 3 : x]
            pixels[area] = self._full[area]
        image = Image.fromarray(pixels)
        draw = ImageDraw.Draw(image)
        for panel in self.panels:
            if panel.top == _TITLE:
                self._name_events(draw, panel, index)
            self._draw_cursor(draw, panel, index)
        return image

    def _place(self, clip: Clip, name: str, index: int, rows: int, width: int) -> _Panel:
        column, row = divmod(index, rows)
        height = self.size[1] / rows
        curves = clip.curves(name)
        low, high = self.span or clip.range(name)
        return _Panel(
            name,
            curves,
            left=column * width + _LEFT,
            top=round(row * height) + _TITLE,
            right=(column + 1) * width - _RIGHT,
            bottom=round((row + 1) * height) - _BOTTOM,
            low=low,
            high=high,
        )

    def _x(self, panel: _Panel, index: int) -> float:
        return panel.left + index / max(self.n - 1, 1) * (panel.right - panel.left)

    def _drawn(self, *, with_curves: bool) -> np.ndarray:
        from PIL import Image, ImageDraw

        width, height = self.size
        image = Image.new("RGB", (width * _SMOOTH, height * _SMOOTH), BACKGROUND)
        draw = ImageDraw.Draw(image)
        for panel in self.panels:
            self._draw_axes(draw, panel)
            if with_curves:
                self._draw_events(draw, panel)
                self._draw_curves(draw, panel)
        return np.asarray(image.resize(self.size, Image.Resampling.LANCZOS))

    def _draw_axes(self, draw: ImageDraw, panel: _Panel) -> None:
        big = _big
        draw.text(
            big(panel.left - _LEFT + 12, panel.top - _TITLE / 2 - 1),
            _shortened(title_of(panel.name), 30),
            fill=INK,
            font=font(13 * _SMOOTH),
            anchor="lm",
        )
        small = font(10 * _SMOOTH)
        for tick in ticks(panel.low, panel.high, 3):
            y = panel.y(tick)
            draw.line([big(panel.left, y), big(panel.right, y)], fill=GRID, width=_SMOOTH)
            where = big(panel.left - 6, y)
            draw.text(where, number_text(tick), fill=FAINT, font=small, anchor="rm")
        for tick in ticks(0, max(self.n - 1, 1), 5):
            if tick == int(tick):
                where = big(self._x(panel, int(tick)), panel.bottom + 5)
                draw.text(where, str(int(tick)), fill=FAINT, font=small, anchor="mt")
        for index in self.breaks:
            x = self._x(panel, index)
            draw.line([big(x, panel.top), big(x, panel.bottom)], fill=FRAME, width=_SMOOTH)
        corner = [big(panel.left, panel.top), big(panel.left, panel.bottom)]
        draw.line([*corner, big(panel.right, panel.bottom)], fill=FRAME, width=_SMOOTH)

    def _draw_events(self, draw: ImageDraw, panel: _Panel) -> None:
        """Draw a line at each event."""
        for index, event in self.events:
            x = self._x(panel, index)
            ends = [_big(x, panel.top), _big(x, panel.bottom)]
            draw.line(ends, fill=_faded(event_color(event)), width=_SMOOTH)

    def _name_events(self, draw: ImageDraw, panel: _Panel, until: int) -> None:
        """Write the names of events, each from its scene on; those without room are left out."""
        letters, free = font(10), 0.0  # from where on nothing is written
        for index, event in self.events:
            x, width = self._x(panel, index), letters.getlength(event)
            left = x + 3 if x + 3 + width <= panel.right else x - 3 - width
            if index <= until and left >= free:
                free = left + width + 3
                where = (left, panel.top + 2)
                draw.text(where, event, fill=event_color(event), font=letters, anchor="lt")

    def _draw_curves(self, draw: ImageDraw, panel: _Panel) -> None:
        for number, curve in enumerate(panel.curves.values()):
            color = COLORS[number % len(COLORS)]
            for start, values in self._segments(curve):
                points = [
                    _big(self._x(panel, start + offset), panel.y(value))
                    for offset, value in enumerate(values)
                ]
                if len(points) > 1:
                    draw.line(points, fill=color, width=round(1.6 * _SMOOTH), joint="curve")
                else:
                    draw.circle(points[0], 1.8 * _SMOOTH, fill=color)

    def _segments(self, curve: Sequence[float | None]) -> Iterator[tuple[int, list[float]]]:
        """Yield runs of numbers without gap and episode boundary, each with its first scene."""
        start = 0
        run: list[float] = []
        for index, value in enumerate(curve):
            if run and (value is None or index in self.breaks):
                yield start, run
                run = []
            if value is not None:
                if not run:
                    start = index
                run.append(value)
        if run:
            yield start, run

    def _draw_cursor(self, draw: ImageDraw, panel: _Panel, index: int) -> None:
        x = self._x(panel, index)
        draw.line([(x, panel.top), (x, panel.bottom)], fill="#a1a1aa", width=1)
        written = panel.right
        for number, (label, curve) in reversed(list(enumerate(panel.curves.items()))):
            value, color = curve[index], COLORS[number % len(COLORS)]
            if value is not None:
                draw.circle((x, panel.y(value)), 3, fill=color, outline=BACKGROUND)
            text = NO_VALUE if value is None else number_text(value)
            if label and len(panel.curves) <= 4:
                text = f"{label}: {text}"
            written = self._write_value(draw, panel, text, color, written)

    @staticmethod
    def _write_value(draw: ImageDraw, panel: _Panel, text: str, color: str, right: int) -> int:
        """Write a current value left of the last one; return where the next one may end."""
        letters = font(12)
        width = draw.textlength(text, font=letters)
        if right - width < panel.left + 9 * min(len(title_of(panel.name)), 30) - _LEFT + 12:
            return 0
        where = (right, panel.top - _TITLE / 2 - 1)
        draw.text(where, text, fill=color, font=letters, anchor="rm")
        return int(right - width - 10)


def event_color(event: str) -> str:
    """Return the color of an event: green for success, red for what went wrong, else gray."""
    if event == "success":
        return REACHED
    return FAILED if any(word in event for word in WENT_WRONG) else FAINT


def _faded(color: str) -> str:
    return "#" + "".join(f"{(int(color[i : i + 2], 16) + 255) // 2:02x}" for i in (1, 3, 5))


def _big(x: float, y: float) -> tuple[float, float]:
    return x * _SMOOTH, y * _SMOOTH


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"…{text[1 - length :]}"
