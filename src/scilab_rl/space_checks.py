"""Spaces that no algorithm can work with, and what to do about them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from scilab_rl.errors import ConfigError

_READABLE = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_EXACT_IN_FLOAT64 = 2.0**53


def bounds_problem(space: spaces.Box) -> str | None:
    """Return why actions cannot be scaled into these bounds, or None if they can."""
    unbounded = ~(space.bounded_below & space.bounded_above)
    is_float = space.dtype.kind == "f"
    dtype: Any = space.dtype
    largest = np.finfo(dtype).max / 2 if is_float else _EXACT_IN_FLOAT64
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    with np.errstate(over="ignore"):
        span = np.maximum(abs(low), abs(high)) if is_float else high - low
        huge = span >= min(float(largest), float(np.finfo(np.float32).max) / 2)
    for is_wrong, why in (
        (unbounded, "no bound"),
        (huge, "bounds so far apart that they mean no bound"),
    ):
        if is_wrong.any():
            index = tuple(map(int, np.argwhere(is_wrong)[0])) if space.shape else ()
            where = f" in dimension {', '.join(map(str, index))}" if index else ""
            return f"{why}{where} (low {space.low[index]}, high {space.high[index]}, {space.dtype})"
    return None


def check_observations(name: str, space: spaces.Space) -> None:
    """Reject observations that no algorithm can read, before a vector of environments is made.

    Args:
        name: The environment's id.
        space: Its observations.

    Raises:
        ConfigError: Names the entry, the environment and the ways out.
    """
    entries = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    unreadable = [key for key, entry in entries.items() if not isinstance(entry, _READABLE)]
    if not unreadable:
        return
    key, readable = unreadable[0], [key for key in entries if key not in unreadable]
    kind = type(entries[key]).__name__
    is_text = any(isinstance(entries[name], spaces.Text) for name in unreadable)
    ways = []
    if space.is_np_flattenable and not is_text:  # the codes of characters are not numbers
        ways.append("add +flatten_obs=1")
    if readable:
        ways.append(
            "leave it out with 'wrappers=[{_target_: gymnasium.wrappers.FilterObservation, "
            f"filter_keys: [{', '.join(readable)}]}}]'"
        )
    ways.append("turn it into a Box with a gymnasium.ObservationWrapper of your own")
    entry = f"observation '{key}'" if key else "the observation"
    raise ConfigError(
        f"{name}: {entry} is a {kind} space, which no algorithm here reads. Ways out: "
        f"{'; or '.join(ways)}."
    )
