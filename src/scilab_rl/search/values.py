"""Values of hyperparameters: when two are the same, and how they are written."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TypeGuard

# Words that Hydra's grammar reads as something else than text.
_WORD = re.compile(r"(?!(?:true|false|null|nan|inf)$)[A-Za-z_][\w./-]*", re.IGNORECASE)


def same_value(one: object, other: object) -> bool:
    """Return whether two values are the same, whatever they look like when they are written.

    Numbers are the same when they are numerically; a boolean is not a number, and text is neither.

    >>> same_value(1, 1.0), same_value(1, True), same_value(True, "true")
    (True, False, False)
    >>> same_value([64, 64], (64, 64.0))
    True
    """
    if is_number(one) and is_number(other):
        return one == other or math.isclose(one, other, rel_tol=1e-9)
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(same_value, one, other))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same_value(one[k], other[k]) for k in one)
    return type(one) is type(other) and bool(one == other)


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a number; a boolean is none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def override_text(value: object) -> str:
    """Return a value as it is typed behind the ``=`` of an override.

    >>> override_text([1, None, "a b", "null"])
    "[1,null,'a b','null']"
    """
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{k}:{override_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(map(override_text, value)) + "]"
    if isinstance(value, str) and not _WORD.fullmatch(value):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return str(value)


def shown_text(value: object) -> str:
    """Return a value as tables and plots show it.

    >>> shown_text(0.98765432), shown_text(None), shown_text("[64,64]")
    ('0.987654', 'null', '[64,64]')
    """
    if isinstance(value, float):
        return f"{value:.6g}"
    return value if isinstance(value, str) else override_text(value)
