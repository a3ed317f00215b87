"""How a task's ``compute_reward`` and ``compute_terminated`` answer for goals put in afterwards.

The doctor, the check before a run and the replay buffer all judge by what is here: the functions
are tried with goals and infos of the task itself, never with made-up ones.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from scilab_rl.errors import ConfigError, did_you_mean, listing

Infos = Sequence[Mapping[str, object]]
# Of a task: takes goals and infos, of one pair or of a batch, and returns a number or several.
TaskFunction = Callable[..., Any]
# Takes achieved goals, desired goals and one info per pair; returns one value per pair.
GoalFunction = Callable[[np.ndarray, np.ndarray, Infos], np.ndarray]
INFO_KEYS = "algorithm.replay_buffer_kwargs.info_keys"
_N_TRIALS = 16


def for_batches(
    function: TaskFunction,
    achieved: np.ndarray,
    desired: np.ndarray,
    infos: Infos,
) -> GoalFunction:
    """Let a function of goals return one value per pair, whatever it was written for.

    Some environments return one constant for all pairs, which is spread over them, and some can
    only answer for a single pair. A trial tells which kind this is.

    Args:
        function: ``compute_reward`` or the like.
        achieved: Goals that were achieved in the task, at least two.
        desired: Goals that were desired.
        infos: Of the same steps.

    Shapes:
        achieved, desired, and goals of the returned function: ``(batch, *goal_shape)``; result:
        ``(batch,)``.
    """
    failure: Exception | None = None
    try:
        together = np.asarray(function(achieved, desired, infos))
    except NotImplementedError:
        raise
    except Exception as error:  # noqa: BLE001 - written for one pair, it may fail in any way
        together, failure = np.asarray(np.nan), error
    if together.shape == (len(achieved),):
        return function
    # Also pairs whose goal is reached: only a true constant is the same for them.
    achieved, desired, infos = achieved[:_N_TRIALS], desired[:_N_TRIALS], infos[:_N_TRIALS]
    try:
        singles = [one_by_one(function, achieved, goals, infos) for goals in (desired, achieved)]
    except Exception:
        if isinstance(failure, KeyError):  # what is missing; the other call was not meant at all
            raise failure from None
        raise
    if together.ndim == 0 and all((values == together).all() for values in singles):
        return partial(_spread, function)
    return partial(one_by_one, function)


def answers_batches(function: GoalFunction) -> bool:
    """Return whether what `for_batches` returned answers all pairs in one call."""
    return getattr(function, "func", None) is not one_by_one


def one_by_one(
    function: TaskFunction, achieved: np.ndarray, desired: np.ndarray, infos: Infos
) -> np.ndarray:
    """Ask a function of goals for each pair alone. Shapes: as in `for_batches`."""
    pairs = zip(achieved, desired, infos, strict=True)
    return np.array([np.asarray(function(*pair)).item() for pair in pairs])


@dataclass(frozen=True)
class InfoNeeds:
    """The infos of steps that a function of goals needs.

    Attributes:
        keys: Keys that it reads, that steps have, and that are not kept for relabelled goals.
        is_required: Whether it fails without them; otherwise its answers may be others.
    """

    keys: tuple[str, ...]
    is_required: bool


def info_needs(
    function: TaskFunction,
    achieved: np.ndarray,
    desired: np.ndarray,
    infos: Infos,
    kept: Collection[str] = (),
) -> InfoNeeds:
    """Find out what a function of goals needs from the infos, by letting it answer for some steps.

    Args:
        function: ``compute_reward`` or the like.
        achieved: Goals that were achieved at these steps.
        desired: Goals that were desired.
        infos: The steps' own, whole.
        kept: Keys that are kept for relabelled goals.
    """
    read: dict[str, None] = {}
    for_batches(function, achieved, desired, [_RecordedInfo(info, read) for info in infos])
    keys = tuple(key for key in read if key not in kept and any(key in info for info in infos))
    few = [{key: info[key] for key in kept if key in info} for info in infos]
    try:
        for_batches(function, achieved, desired, few)
    except Exception:  # noqa: BLE001 - a missing entry shows in many ways
        return InfoNeeds(keys, True)
    return InfoNeeds(keys, False)


def reads_infos(function: TaskFunction, achieved: np.ndarray, desired: np.ndarray) -> bool:
    """Return whether a function of goals looks at infos, or fails without any."""
    read: dict[str, None] = {}
    try:
        for_batches(function, achieved, desired, [_RecordedInfo({}, read) for _ in achieved])
    except NotImplementedError:
        return False
    except Exception:  # noqa: BLE001 - a missing entry shows in many ways
        return True
    return bool(read)


def refuse_unknown_keys(kept: Iterable[str], infos: Infos) -> None:
    """Reject ``info_keys`` that steps do not have, or that are not numbers.

    Raises:
        ConfigError: With the keys there are.
    """
    known = {key: value for info in infos for key, value in info.items()}
    for key in kept:
        if key not in known:
            raise ConfigError(
                f"{INFO_KEYS}: the infos of this environment's steps have no '{key}'."
                f"{did_you_mean(key, known)} They have: {listing(known) or 'nothing'}."
            )
        if not is_number(known[key]):
            raise ConfigError(
                f"{INFO_KEYS}: '{key}' is {known[key]!r} and not one number. Whole infos are kept "
                "by algorithm.replay_buffer_class=her with replay_buffer_kwargs.copy_info_dict."
            )


def is_number(value: object) -> bool:
    """Return whether a replay buffer can keep this entry of an info."""
    array = np.asarray(value)
    return array.ndim == 0 and array.dtype.kind in "biuf"


class _RecordedInfo(dict[str, object]):
    """An info that remembers which of its keys were looked at."""

    def __init__(self, info: Mapping[str, object], read: dict[str, None]) -> None:
        super().__init__(info)
        self._read = read

    def __getitem__(self, key: str) -> object:
        self._read[key] = None
        return super().__getitem__(key)

    def get(self, key: str, default: object = None) -> object:
        self._read[key] = None
        return super().get(key, default)

    def __contains__(self, key: object) -> bool:
        self._read[str(key)] = None
        return super().__contains__(key)


def _spread(
    function: TaskFunction, achieved: np.ndarray, desired: np.ndarray, infos: Infos
) -> np.ndarray:
    return np.broadcast_to(function(achieved, desired, infos), len(achieved))
