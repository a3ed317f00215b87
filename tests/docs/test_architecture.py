"""The pages for contributors name files that exist, and the layers that are checked."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from .pages import DOCS, ROOT

PACKAGE = ROOT / "src" / "scilab_rl"
ARCHITECTURE = DOCS / "contributing" / "architecture.md"
PAGES = [ARCHITECTURE, DOCS / "contributing" / "recipes.md", ROOT / "CONTRIBUTING.md"]
# Files of a reader or of a run, not of the repository.
EXAMPLES = re.compile(r"(^|/)(custom_|my_|test_my_|name\.|test_name|metrics\.jsonl)|[A-Z]{4}")


def named_files(page: Path) -> set[str]:
    """Return the files that a page names in its text."""
    text = re.sub(r"(?ms)^```.*?^```", "", page.read_text(encoding="utf-8"))
    files = re.findall(r"`([\w./-]+\.(?:py|yaml|md|html|toml|txt|sh|jsonl))`", text)
    return {file for file in files if not EXAMPLES.search(file)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_exist(page: Path) -> None:
    files = named_files(page)
    assert len(files) >= 3
    missing = [f for f in files if not (PACKAGE / f).is_file() and not (ROOT / f).is_file()]
    assert missing == []


def test_layers_are_those_that_are_checked() -> None:
    tomllib = pytest.importorskip("tomllib")  # from Python 3.11 on
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    checked = project["tool"]["importlinter"]["contracts"][0]["layers"]
    section = ARCHITECTURE.read_text(encoding="utf-8").partition("## Layers\n")[2]
    block = section.partition("```text\n")[2].partition("```")[0]
    assert [re.split(r"  +", line)[0] for line in block.splitlines()] == checked
