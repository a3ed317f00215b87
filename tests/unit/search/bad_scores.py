"""Scores of one's own that are none."""

from __future__ import annotations

import math
from typing import Any


def nan(curve: Any) -> float:
    return math.nan


def infinite(curve: Any) -> float:
    return -math.inf


def text(curve: Any) -> str:
    return "0.5"


def nothing(curve: Any) -> None:
    return None


def several(curve: Any) -> list[float]:
    return [0.5, 0.6]
