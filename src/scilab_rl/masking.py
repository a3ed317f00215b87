"""Keeping secrets out of what is written and shown: keys, tokens, passwords."""

from __future__ import annotations

import logging
import os
import re

MASK = "***"
_SHORTEST = 8  # shorter values of variables would hide ordinary words
_VARIABLE = re.compile(r"(API_?KEY|TOKEN|SECRET|PASSWORD|PASSWD|ACCESS_KEY)$", re.IGNORECASE)
_IN_ADDRESS = re.compile(r"(?<=://)[^/\s:@]*:[^/\s@]+(?=@)")
_NAMED = re.compile(
    r"((?:api_?key|(?:auth|access|api)_?token|password|secret)[\"']?\s*[:=]\s*[\"']?)"
    r"(?!null\b|[\"'])[^\s\"',}]+",
    re.IGNORECASE,
)


def mask(text: str) -> str:
    """Replace what must not be read by others by ``***``.

    That is: passwords in addresses, the values of environment variables that are called a key,
    token, secret or password, and what stands behind such a name.

    >>> mask("postgresql://ada:lovelace@host/runs")
    'postgresql://***@host/runs'
    >>> mask("api_key: 123456")
    'api_key: ***'
    """
    for name, value in os.environ.items():
        if len(value) >= _SHORTEST and _VARIABLE.search(name):
            text = text.replace(value, MASK)
    return _NAMED.sub(rf"\g<1>{MASK}", _IN_ADDRESS.sub(MASK, text))


class MaskingFormatter(logging.Formatter):
    """A log format in which secrets are masked."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, with the traceback if there is one."""
        return mask(super().format(record))
