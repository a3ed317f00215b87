"""The table in docs/reliability.md says what the tests are, and all of them are there."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "reliability.md"
_ROW = re.compile(r"\| (F\d\d) \| (P\d) \| .* \| (.*) \|")


def rows() -> dict[str, tuple[str, Counter[str]]]:
    """Return each row's priority, and how many tests it names in which file."""
    found = {}
    for number, priority, tests in _ROW.findall(DOCUMENT.read_text(encoding="utf-8")):
        named = re.findall(r"`([\w/]+\.py)` \((\d+)\)", tests)
        found[number] = (priority, Counter({path: int(n) for path, n in named}))
    return found


def existing() -> dict[str, Counter[str]]:
    """Return the tests that are named after a row, and their files."""
    found: dict[str, Counter[str]] = {}
    for path in (ROOT / "tests").rglob("test_*.py"):
        for number in re.findall(r"def test_(f\d\d)_", path.read_text(encoding="utf-8")):
            name = path.relative_to(ROOT / "tests").as_posix()
            found.setdefault(number.upper(), Counter())[name] += 1
    return found


def test_all_rows_are_there() -> None:
    assert sorted(rows()) == [f"F{number:02d}" for number in range(1, 43)]


@pytest.mark.parametrize("number", [f"F{number:02d}" for number in range(1, 43)])
def test_row_names_the_tests_that_exist(number: str) -> None:
    priority, named = rows()[number]
    assert named == existing().get(number, Counter())
    assert priority != "P0" or named, f"{number} must hold, and no test shows it"


def test_exit_codes_are_those_of_the_code() -> None:
    from scilab_rl import errors
    from scilab_rl.cli import main as cli
    from scilab_rl.results import EXIT_REQUEUE

    text = DOCUMENT.read_text(encoding="utf-8")
    stated = {int(code) for code in re.findall(r"^\| (\d+) \|", text, re.MULTILINE)}
    assert stated == {
        0,
        errors.ScilabRLError.exit_code,
        errors.ConfigError.exit_code,
        errors.SomeRunsFailedError.exit_code,
        EXIT_REQUEUE,
        cli.EXIT_INTERRUPTED,
        cli.EXIT_PIPE_CLOSED,
        143,
    }
