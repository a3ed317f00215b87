"""Names for places that do not take every name: different names stay different.

What is not allowed becomes ``_x<code point>_``, so that ``train/α`` is ``train/_x3b1_``. A name in
which nothing has to change stays as it is.
"""

from __future__ import annotations

import hashlib
import posixpath
import re

_ESCAPE = re.compile(r"_x(?=[0-9a-z]+_)")  # what looks like an escape is escaped itself
_N_HASH = 16


def encoded(name: str, refused: re.Pattern[str], most_characters: int | None = None) -> str:
    """Return the name as a place takes it.

    A name that is too long ends with a hash of all of it.

    Args:
        name: The name.
        refused: Finds each character that the place refuses.
        most_characters: The longest name that the place takes; None: any.

    >>> encoded("train/α", re.compile(r"[^a-z/]")), encoded("a_x3b1_", re.compile("[^a-z0-9_]"))
    ('train/_x3b1_', 'a_x5f_x3b1_')
    """
    text = _ESCAPE.sub("_x5f_x", name)
    text = refused.sub(lambda found: "".join(f"_x{ord(c):x}_" for c in found[0]), text)
    if most_characters is None or len(text) <= most_characters:
        return text
    digest = hashlib.sha256(name.encode()).hexdigest()[:_N_HASH]
    ending = f"_xhash{digest}_"
    return text[: most_characters - len(ending)] + ending


def is_plain_path(name: str) -> bool:
    """Return whether a name is a relative path in its shortest form, such as ``train/loss``."""
    return name == posixpath.normpath(name) and not name.startswith(("/", "..")) and name != "."
