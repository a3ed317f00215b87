"""Reading success from what an environment says about a step, and counting it over episodes."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence

import numpy as np

SUCCESS_KEYS = ("is_success", "success")


def success_of(info: Mapping[str, object]) -> bool | None:
    """Return the success that a step's info reports; None where it reports none.

    Success may be reported at each step or only at the end of an episode, as True or False, 0 or 1,
    or an array with exactly one of these. None counts as not reported.

    Raises:
        ValueError: If it is anything else, such as NaN, text or several values.
    """
    for key in SUCCESS_KEYS:
        value = info.get(key)
        if value is not None:
            return value if type(value) is bool else _truth_value(key, value)
    return None


def episode_outcomes(
    reported: Sequence[bool | None], *, reports_success: bool = False
) -> list[bool] | None:
    """Return which episodes succeeded; one that reported nothing counts as not successful.

    Otherwise a task that reports success only when it succeeds would have a rate of 1.

    Args:
        reported: What each episode reported at its end; None: nothing.
        reports_success: Whether the task is known to report success, from other episodes.

    Returns:
        None where nothing says that the task has a notion of success.

    >>> episode_outcomes([True, None, False])
    [True, False, False]
    >>> episode_outcomes([None, None])
    """
    if not reports_success and all(success is None for success in reported):
        return None
    return [bool(success) for success in reported]


def success_metrics(outcomes: Sequence[bool], reported: Sequence[bool | None]) -> dict[str, float]:
    """Return the rate over all episodes and, if there are any, how many reported nothing.

    >>> success_metrics([True, False], [True, None])
    {'success_rate': 0.5, 'success_not_reported': 1.0}
    """
    metrics = {"success_rate": float(np.mean(outcomes))}
    n_silent = sum(success is None for success in reported)
    return metrics | ({"success_not_reported": float(n_silent)} if n_silent else {})


def _truth_value(key: str, value: object) -> bool:
    array = np.asarray(value)
    if array.size == 1 and array.dtype.kind in "biuf" and array.item() in (0, 1):
        return bool(array.item())
    raise ValueError(
        f"info['{key}'] is {reprlib.repr(value)}, but success must be True or False (0 or 1)"
    )
