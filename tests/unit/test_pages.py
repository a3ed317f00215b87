"""Pages are one file each, in one style, and what goes into them is escaped."""

from __future__ import annotations

import re
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
    namespace = "http://www.w3.org/2000/svg"  # a name, which nobody fetches
    text = template.read_text(encoding="utf-8").replace(namespace, "")
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
    text = page.render(
        Summary(EVIL, definition, [run], rows, (), (), 0.0, {}), {"Contour" + EVIL: image}
    )
    assert EVIL not in text
    assert text.count("&lt;script&gt;") >= 6
    assert '<img src="data:image/png;base64,iVBORw==' in text
    assert '<span class="state winner">winner</span>' in text
    assert "<td>-</td>" in text  # the second setting has no value


def test_a_study_says_what_each_parameter_does_and_what_was_never_tried() -> None:
    definition = {
        "space": {
            "rate": {"low": 1e-4, "high": 1e-1, "log": True},
            "net": {"choices": ["small", "large", "huge"]},
        },
        "score": ["auc"], "criterion": "eval/success_rate", "algorithm": "sac", "env": "E",
        "directions": ["maximize"],
    }  # fmt: skip
    rows = [
        ConfigurationRow(0, {"rate": 1e-3, "net": "small"}, 1, 0.75, 0.1, "winner"),
        ConfigurationRow(1, {"rate": 2e-3, "net": "large"}, 1, 0.25, 0.1, "beaten"),
    ]
    runs = [
        Run(i, i, 0, 1, "complete", "", 0.0, (row.mean,), (0.0, row.mean), (100, 200))
        for i, row in enumerate(rows)
    ]
    text = page.render(Summary("s", definition, runs, rows, (), (), 0.0, {"net": 0.5}), {})
    assert "area under the curve divided by the budget" in text
    cells = re.findall(r"<tr><td>(rate|net)</td><td>(.*?)</td><td>(.*?)</td></tr>", text)
    assert cells == [
        ("rate", "2 values, 0.001 to 0.002 of 0.0001 to 0.1", "0.0001 to 0.001, 0.002 to 0.1"),
        ("net", "2 of 3 choices", "huge"),
    ]
    assert "M33.333 25.0h.01M43.368 75.0h.01" in text  # both scores over the rate
    assert "width:50.0%" in text


def test_a_forgotten_value_is_no_empty_place() -> None:
    with pytest.raises(UndefinedError, match="title"):
        pages.render("highlights.html")
