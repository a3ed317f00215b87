"""One form for all that ``render()`` may return: ``(height, width, 3)`` in uint8."""

from __future__ import annotations

import numpy as np

_WHITE = 255
_LONGEST_SIDE = 4096  # pixels; more does not fit a video or a JPEG file
# Filters and sums overshoot: up to here a frame of floats still counts as one in [0, 1], or black.
_ONE, _ZERO = 2.0, -0.5
_RULE = "a frame is (height, width) with 1, 3 or 4 channels last"


class PictureForm:
    """Brings the frames of one environment to one form.

    What a number means follows from its dtype: integers are 0..255, truth values are black and
    white. Floats are 0..1 or 0..255, and the largest one seen so far in this environment decides,
    because a dark frame alone could be either.
    """

    def __init__(self) -> None:
        self._brightest = 0.0

    def picture(self, frame: object) -> np.ndarray:
        """Return a frame as a picture with memory of its own.

        Args:
            frame: What ``render()`` has returned: gray, RGB or RGBA; RGBA is laid on white.

        Shapes:
            frame: ``(height, width[, 1 | 3 | 4])``; result: ``(height, width, 3)``, uint8.

        Raises:
            ValueError: If it is not a picture, with the reason.
        """
        pixels = self._in_bytes(_as_pixels(frame))
        if pixels.shape[2] == 4:
            pixels = _on_white(pixels)
        return np.array(np.broadcast_to(pixels, (*pixels.shape[:2], 3)), np.uint8, order="C")

    def _in_bytes(self, pixels: np.ndarray) -> np.ndarray:
        if pixels.dtype == np.uint8:
            return pixels
        if pixels.dtype == np.bool_:
            return np.where(pixels, np.uint8(_WHITE), np.uint8(0))
        low, high = float(pixels.min()), float(pixels.max())
        is_float = pixels.dtype.kind == "f"
        if not (np.isfinite(low) and np.isfinite(high)):
            raise ValueError("its frame holds NaN or infinite values")
        if low < (_ZERO if is_float else 0) or high > _WHITE + is_float:
            raise ValueError(
                f"its frame has values from {low:g} to {high:g}: floats are in 0..1 or 0..255, "
                "integers in 0..255"
            )
        if not is_float:
            return pixels.astype(np.uint8)
        self._brightest = max(self._brightest, high)
        scale = _WHITE if self._brightest <= _ONE else 1
        scaled = np.rint(pixels.astype(np.float32) * scale)
        return np.clip(scaled, 0, _WHITE).astype(np.uint8)


def _as_pixels(frame: object) -> np.ndarray:
    """Return a frame as an array of three dimensions, made smaller if it is huge.

    Raises:
        ValueError: If it is none.
    """
    if frame is None:
        raise ValueError("render() returned None")
    if isinstance(frame, str | bytes):
        raise ValueError("render() returned text")
    try:
        pixels = np.asarray(frame)
    except Exception as error:
        raise ValueError(f"render() returned no array, but {type(frame).__name__}") from error
    if pixels.dtype.kind not in "buif":
        raise ValueError(f"render() returned {type(frame).__name__} of {pixels.dtype}; {_RULE}")
    shape = pixels.shape
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or not pixels.size:
        raise ValueError(f"its frame has shape {shape}; {_RULE}")
    every = -(-max(pixels.shape[:2]) // _LONGEST_SIDE)
    return pixels[::every, ::every]


def _on_white(pixels: np.ndarray) -> np.ndarray:
    colors, opacity = pixels[..., :3], pixels[..., 3:]
    if opacity.min() == _WHITE:
        return colors
    share = opacity / np.float32(_WHITE)
    return np.rint(colors * share + _WHITE * (1 - share)).astype(np.uint8)
