"""What environments are like with the pinned versions, for a list that makes none of them."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

SPACES = Path(__file__).parent / "assets" / "spaces.json"
UNKNOWN: dict[str, Any] = {"observation": None, "action": None, "goal": None}


def spaces_of(env_id: str) -> dict[str, Any]:
    """Return the spaces of an environment as short texts, and whether it has goals.

    Args:
        env_id: An id with its version.

    Returns:
        ``observation``, ``action`` and ``goal``; None for one that is not recorded.
    """
    return {**UNKNOWN, **_recorded().get(env_id, {})}


@functools.cache
def _recorded() -> dict[str, dict[str, Any]]:
    return json.loads(SPACES.read_text(encoding="utf-8"))
