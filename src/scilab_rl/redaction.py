"""Keeping secrets out of what is written and shown: keys, tokens, passwords."""

from __future__ import annotations

import logging
import os
import re

REDACTED = "***"
_SHORTEST = 8  # shorter values of variables would hide ordinary words
_VARIABLE = re.compile(r"(API_?KEY|TOKEN|SECRET|PASSWORD|PASSWD|ACCESS_KEY)$", re.IGNORECASE)
_IN_ADDRESS = re.compile(r"(?<=://)[^/\s:@]*:[^/\s@]+(?=@)")
# `name: value`, `"name": "value"`, `name = "value"`, `name: str = f"value"`.
_IS = r"[\"']?\]?[ \t]*(?::[\w.\[\], |]+[ \t]=|:?={1,2}|:)[ \t]*"
_NAMED = re.compile(
    r"((?:api_?key|(?:auth|access|api)_?token|passw(?:or)?d|secret(?:_?(?:access_?)?key)?"
    rf"|(?:access|private)_?key){_IS})"
    r"(?!(?:null|None)\b)"
    r"(?:([\"'])(?:(?!\2).)+\2|[\"']?[^\s\"',}]+(?:\"[^\"\n]*\"|'[^'\n]*')?)",
    re.IGNORECASE,
)
# Words that mean other things too, as in `pad_token: 0`: only with a value that looks drawn.
_NAMED_LONG = re.compile(
    rf"((?:token|key|credentials?){_IS}[\"']?)(?=[a-z]*\d)[a-z0-9]{{20,}}", re.IGNORECASE
)
# The forms of GitHub, GitLab, Hugging Face, OpenAI, AWS, Slack and Google, and JSON web tokens.
_FORMS = re.compile(
    r"\b(?:gh[pousr]_\w{20,}|github_pat_\w{20,}|glpat-[\w-]{20,}|hf_[A-Za-z0-9]{30,}|sk-[\w-]{20,}"
    r"|AKIA[0-9A-Z]{16}|xox[abprs]-[\w-]{10,}|AIza[\w-]{35}|eyJ[\w-]{10,}\.[\w-]+\.[\w-]+)"
)
_PRIVATE_KEY = re.compile(
    r"(-----BEGIN [A-Z ]*PRIVATE KEY-----).*?(-----END [A-Z ]*PRIVATE KEY-----)", re.DOTALL
)


def redact(text: str) -> str:
    """Replace what must not be read by others by ``***``.

    That is: passwords in addresses, the values of environment variables that are called a key,
    token, secret or password, what stands behind such a name in configuration or code, and what
    looks like a key of a known service.

    >>> redact("postgresql://ada:lovelace@host/runs")
    'postgresql://***@host/runs'
    >>> redact("api_key: 123456")
    'api_key: ***'
    """
    for name, value in os.environ.items():
        if len(value) >= _SHORTEST and _VARIABLE.search(name):
            text = text.replace(value, REDACTED)
    text = _PRIVATE_KEY.sub(rf"\g<1>{REDACTED}\g<2>", _IN_ADDRESS.sub(REDACTED, text))
    text = _NAMED.sub(lambda found: f"{found[1]}{found[2] or ''}{REDACTED}{found[2] or ''}", text)
    return _FORMS.sub(REDACTED, _NAMED_LONG.sub(rf"\g<1>{REDACTED}", text))


class RedactingFormatter(logging.Formatter):
    """A log format in which secrets are masked."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, with the traceback if there is one."""
        return redact(super().format(record))
