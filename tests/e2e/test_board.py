"""The board in a real browser: it shows, filters, remembers in the address, and follows."""

from __future__ import annotations

import importlib.util
import json
import threading
from pathlib import Path

import pytest

from scilab_rl.analysis.board import write_board
from scilab_rl.cli.board import BoardServer
from tests.e2e.chromium import EXECUTABLE, Chromium
from tests.e2e.commands import ROOT

_spec = importlib.util.spec_from_file_location("board_benchmark", ROOT / "benchmarks" / "board.py")
assert _spec is not None
assert _spec.loader is not None
_benchmark = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_benchmark)
make_runs = _benchmark.make_runs

pytestmark = pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")
READY = "document.body.dataset.ready"
NAMES = "[...document.querySelectorAll('#chosen li')].map(one => one.textContent)"


def test_it_shows_filters_and_remembers(tmp_path: Path) -> None:
    make_runs(tmp_path, 50, n_epochs=4)
    page = write_board(tmp_path).as_uri()
    with Chromium() as browser:
        browser.open(page)
        browser.wait_for(READY)
        rows = "document.querySelectorAll('tr.group').length"
        assert browser.evaluate(rows) == 8  # two more belong to the study
        browser.evaluate("$('study').value = 'wide', $('study').dispatchEvent(new Event('input'))")
        assert browser.evaluate(rows) == 2
        browser.evaluate("$('metric').value = 'eval/mean_reward', "
                         "$('metric').dispatchEvent(new Event('input'))")  # fmt: skip
        address = browser.evaluate("location.href")
        assert "study=wide" in address
        chosen = browser.evaluate(NAMES)
        browser.open("about:blank?")
        browser.open(address)
        browser.wait_for(READY)
        assert browser.evaluate(rows) == 2
        assert browser.evaluate("$('metric').value") == "eval/mean_reward"
        assert browser.evaluate(NAMES) == chosen
        browser.evaluate("document.querySelector('tr.group').click()")
        links = browser.evaluate("[...document.querySelectorAll('.links a')].map(one => one.href)")
        found = [link for link in links if link.endswith("/curve.png")]
        assert len(found) == 5
        assert all(Path(link.removeprefix("file://")).is_file() for link in found)


def test_it_follows_the_runs(tmp_path: Path) -> None:
    make_runs(tmp_path, 10, n_epochs=2)
    with BoardServer(tmp_path, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            with Chromium() as browser:
                browser.open(server.address)
                browser.wait_for(READY)
                result = next(tmp_path.glob("*/*-s1-0001/result.json"))
                stored = json.loads(result.read_text()) | {"status": "interrupted"}
                result.write_text(json.dumps(stored))
                seen = "[...$('status').options].some(one => one.value === 'interrupted')"
                browser.wait_for(seen)
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.slow
def test_a_thousand_runs_are_a_small_page(tmp_path: Path) -> None:
    make_runs(tmp_path, 1000)
    page = write_board(tmp_path)
    assert page.stat().st_size < 15_000_000
    with Chromium() as browser:
        browser.open(page.as_uri())
        browser.wait_for(READY)
        assert browser.evaluate("$('about').textContent").startswith("1,000 runs")
