"""Results of the doctor's checks."""

from __future__ import annotations

from dataclasses import dataclass

OK, INFO, WARN, FAIL = "ok", "info", "warn", "fail"


@dataclass(frozen=True)
class CheckResult:
    """One line of the report.

    Attributes:
        check: What was looked at.
        result: ``ok``, ``info`` (optional and not there), ``warn`` (something will not work) or
            ``fail`` (do not train before it is repaired).
        found: What is there.
        fix: What to do about it.
    """

    check: str
    result: str
    found: str
    fix: str | None = None
