"""Reading success from what an environment says about a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SUCCESS_KEYS = ("is_success", "success")


def success_of(info: Mapping[str, Any]) -> bool | None:
    """Return whether the step's info reports success, or None when the task has no such notion."""
    for key in SUCCESS_KEYS:
        if key in info:
            return bool(info[key])
    return None
