"""The site: built without a warning, complete, and without anything from elsewhere."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scilab_rl.cli.main import COMMANDS
from scilab_rl.config.schema import KEYS
from scilab_rl.config.workspace import config_files
from scilab_rl.metrics.probes import PROBE_NAMES

from ..e2e.chromium import EXECUTABLE, Chromium
from ..e2e.commands import quiet_environment
from .pages import ROOT, pages

# What a browser would fetch without being asked.
_FETCHED = re.compile(
    r"<(?:script|img|iframe|source)[^>]+src=\"?(https?:[^\" >]+)"
    r"|<link[^>]+href=\"?(https?:[^\" >]+)"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("material", reason="needs the extra [docs]")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, env=quiet_environment(NO_MKDOCS_2_WARNING="1"), capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not re.search(r"WARNING|ERROR", done.stderr), done.stderr
    return folder


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    fetched = {found for page in site.rglob("*.html") for found in _FETCHED.findall(text_of(page))}
    assert {a or b for a, b in fetched if "canonical" not in a + b} == set()
    styles = "".join(text_of(path) for path in site.rglob("*.css"))
    assert not re.search(r"url\([\"']?https?:", styles)


@pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")
def test_search_works_in_pages_opened_from_disk(site: Path) -> None:
    with Chromium() as browser:
        browser.open(f"{(site / 'howto' / 'search.html').as_uri()}?q=permutation")
        found = "document.querySelector('.md-search-result__meta').textContent"
        browser.wait_for(f"/matching document/.test({found})")
        assert browser.evaluate("document.querySelectorAll('.md-search-result__item').length") > 0


def test_reference_is_complete(site: Path) -> None:
    keys = text_of(site / "reference" / "keys.html")
    assert [key.name for key in KEYS if f"<code>{key.name}</code>" not in keys] == []
    commands = text_of(site / "reference" / "commands.html")
    assert [name for name in COMMANDS if f'id="{name}"' not in commands] == []
    metrics = text_of(site / "reference" / "metrics.html")
    assert [name for name in PROBE_NAMES if f"<code>{name}</code>" not in metrics] == []
    algorithms = text_of(site / "reference" / "algorithms.html")
    shipped = config_files("algorithm")
    assert [name for name in shipped if f'id="{name}"' not in algorithms] == []
    api = text_of(site / "reference" / "api.html")
    assert "OneFileAlgorithm" in api and "sample_goal" in api


def test_environments_show_what_has_been_learned(site: Path) -> None:
    page = text_of(site / "environments.html")
    baselines = (ROOT / "baselines").glob("*/*.json")
    names = [f"{path.parent.name}/{path.stem}" for path in baselines]
    assert names and [name for name in names if f"<code>{name}</code>" not in page] == []
    assert "<td>fail</td>" in page


def test_external_links_are_well_formed_and_few_hosts() -> None:
    """They are listed, not fetched: a test must not depend on other people's servers."""
    links = {
        link for page in pages() for link in re.findall(r"\]\((https?://[^)\s]+)\)", text_of(page))
    }
    hosts = {link.split("/")[2] for link in links}
    assert hosts <= {"arxiv.org", "github.com"}, hosts


def test_every_picture_is_used_somewhere() -> None:
    texts = "".join(text_of(page) for page in [*pages(), ROOT / "README.md"])
    texts += "".join(text_of(p) for p in (ROOT / "docs").rglob("*.py"))
    images = ROOT / "docs" / "images"
    figures = sorted([*images.rglob("*.png"), *images.rglob("*.webp")])
    assert len(figures) > 10
    assert [path.name for path in figures if path.name not in texts] == []


def test_figures_are_drawn_from_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(str(ROOT))
    figures = importlib.import_module("docs.figures.__main__")
    monkeypatch.setattr(figures, "IMAGES", tmp_path)
    for draw in figures.FIGURES:
        draw()
    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {path.name for path in (ROOT / "docs" / "images").glob("figure_*.png")}
    kept = json.loads(text_of(figures.CURVES))
    lengths = {len(run) for name in ("with hindsight", "without") for run in kept[name]}
    assert lengths == {len(kept["steps"])}
    assert len(kept["without"]) == len(kept["with hindsight"]) == figures.N_SEEDS


def test_a_diff_holds_both_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without what is new it is the old file's function, and without what is gone the new one's."""
    monkeypatch.syspath_prepend(str(ROOT))
    generate = importlib.import_module("docs.generate")
    functions = ["soft_targets", "critic_loss", "contrastive_loss", "actor_loss"]
    old, new = (generate._functions_of(name) for name in ("jaxsac", "jaxcrl"))
    lines = [line for line in generate.diff_of(old, new, functions) if line]
    for kept, of in ((" -", old), (" +", new)):
        shown = [line[1:] for line in lines if line[0] in kept]
        assert shown == [line for name in functions for line in of.get(name, [])]
    page = generate.on_page_markdown((ROOT / "docs" / "explain" / "goals.md").read_text("utf-8"))
    assert "\n+def contrastive_loss(" in page and "\n-def soft_targets(" in page
    assert "<!-- diff" not in page and "```diff" in page
