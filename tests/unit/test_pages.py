"""Pages are one file each, in one style, and what goes into them is escaped."""

from __future__ import annotations

from pathlib import Path

import pytest
from jinja2 import UndefinedError

from scilab_rl import pages
from scilab_rl.search import page
from scilab_rl.search.runs import Run
from scilab_rl.search.summary import ConfigurationRow, Summary

TEMPLATES = Path(pages.__file__).with_name("templates")
EVIL = "<script>alert(1)</script>"


@pytest.mark.parametrize("template", sorted(TEMPLATES.glob("*.html")), ids=lambda path: path.stem)
def test_a_page_needs_nothing_else_and_has_the_common_style(template: Path) -> None:
    text = template.read_text(encoding="utf-8")
    assert "://" not in text and "<link" not in text and "| safe" not in text
    assert template.stem == "macros" or 'extends "base.html"' in text or '"style.css"' in text


def test_what_goes_into_a_page_is_escaped(tmp_path: Path) -> None:
    image = tmp_path / "x.png"
    image.write_bytes(b"\x89PNG")
    definition = {
        "space": {EVIL: {}}, "score": ["default"], "criterion": "eval/success_rate",
        "algorithm": "sac", "env": EVIL, "directions": ["maximize"],
    }  # fmt: skip
    rows = [
        ConfigurationRow(0, {EVIL: 0.5}, 2, 0.9, 0.1, "winner"),
        ConfigurationRow(1, {}, 0, None, 0, ""),
    ]
    run = Run(0, 0, 0, 1, "failed", "", 0.0, error=EVIL)
    text = page.render(Summary(EVIL, definition, [run], rows, (), (), 0.0, {}), {EVIL: image})
    assert EVIL not in text
    assert text.count("&lt;script&gt;") >= 6
    assert '<img src="data:image/png;base64,iVBORw==' in text
    assert '<span class="state winner">winner</span>' in text
    assert "<td>-</td>" in text  # the second setting has no value


def test_a_forgotten_value_is_no_empty_place() -> None:
    with pytest.raises(UndefinedError, match="title"):
        pages.render("highlights.html")
