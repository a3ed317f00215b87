"""Text on the command line, quoted where Hydra's grammar could not read it as text."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath

import numpy as np
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import OverrideParseException

from scilab_rl.errors import ConfigError

_PLAIN = re.compile(r"[\w./:-]+")  # text that means itself, also in lists and mappings
# The entries of a list: in quotes, or up to the next comma.
_ENTRY = re.compile(r"""\s*('(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[^,]*)\s*(?:,|$)""", re.DOTALL)


def as_text(value: str, *, may_sweep: bool = True) -> str:
    """Return a value such that Hydra reads it as text, whatever characters it has.

    Args:
        value: As it was typed, after the shell has taken its quotes.
        may_sweep: Whether ``a,b`` are two values of a multirun rather than one text.

    >>> as_text("critic_variance > p99")
    "'critic_variance > p99'"
    >>> as_text("FetchReach"), as_text("'in quotes'"), as_text("null")
    ('FetchReach', "'in quotes'", 'null')
    >>> as_text("2024"), as_text("a, b", may_sweep=False)
    ("'2024'", "'a, b'")
    """
    read = _read(value)
    if read is not None and read.is_sweep_override():
        return value if may_sweep else _quoted(value)
    if read is not None and (read.value() is None or isinstance(read.value(), str)):
        return value
    return _quoted(value)


def as_texts(value: str) -> str:
    """Return a list in brackets such that Hydra reads each of its entries as text.

    >>> as_texts("[pilot, lr > 0.1, 'a, b']")
    "[pilot,'lr > 0.1','a, b']"
    """
    if not (value.startswith("[") and value.endswith("]")) or _read(value) is not None:
        return value
    entries = [match[1].strip() for match in _ENTRY.finditer(value[1:-1])]
    return f"[{','.join(as_text(entry, may_sweep=False) for entry in entries if entry)}]"


def tuple_as_list(value: str) -> str:
    """Return a tuple as it is written in Python as the list that Hydra can read.

    >>> tuple_as_list("(1, 'episode')"), tuple_as_list("(64,)"), tuple_as_list("0.9")
    ("[1, 'episode']", '[64]', '0.9')
    """
    is_tuple = value.startswith("(") and value.endswith(")") and "(" not in value[1:]
    return f"[{value[1:-1].rstrip(', ')}]" if is_tuple else value


def as_override(key: str, value: object) -> str:
    """Return a value of Python for a key, as it would be typed on the command line.

    Raises:
        ConfigError: If it is nothing that a configuration can hold.

    >>> as_override("seed", 1), as_override("info", "a, b"), as_override("mlflow", None)
    ('seed=1', "info='a, b'", 'mlflow=null')
    >>> as_override("env_kwargs", {"reward_type": "dense", "goals": (1, 2.5)})
    'env_kwargs={reward_type:dense,goals:[1,2.5]}'
    """
    try:
        return f"{key}={_written(value)}"
    except TypeError as error:
        raise ConfigError(
            f"{key} takes numbers, text, lists, mappings or classes, but it is {value!r}."
        ) from error


def _written(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, (bool, np.bool_)):
        return str(bool(value)).lower()
    if isinstance(value, (np.generic, np.ndarray)):
        return _written(value.tolist())
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    if isinstance(value, (str, PurePath)):
        text = str(value)
        read = _read(text) if _PLAIN.fullmatch(text) else None
        return text if read is not None and read.value() == text else _quoted(text)
    if isinstance(value, Mapping):
        return f"{{{','.join(f'{name}:{_written(entry)}' for name, entry in value.items())}}}"
    if isinstance(value, Sequence):
        return f"[{','.join(map(_written, value))}]"
    raise TypeError


def read_changes(overrides: Sequence[str]) -> Iterator[tuple[str, object]]:
    """Yield key and value of each override.

    Raises:
        ConfigError: If one is not a single value.
        OverrideParseException: If one cannot be read.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        if override.is_sweep_override() or override.is_delete():
            raise ConfigError(f"'{override.input_line}' must be KEY=VALUE with one value.")
        yield override.key_or_group, override.value()


def _read(value: str) -> Override | None:
    try:
        return OverridesParser.create().parse_overrides([f"key={value}"])[0]
    except OverrideParseException:
        return None


def _quoted(value: str) -> str:
    return QuotedString(text=value, quote=Quote.single).with_quotes()
