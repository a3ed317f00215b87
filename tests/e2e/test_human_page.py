"""People play in a real browser: keys, a reload in the middle, two windows, a server that ends."""

from __future__ import annotations

import csv
import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from scilab_rl.cli.human import HumanServer
from scilab_rl.config.compose import compose
from scilab_rl.run.human import HumanSessions
from tests.e2e.chromium import EXECUTABLE, Chromium

LEFT, RIGHT = "ArrowLeft", "ArrowRight"


@contextmanager
def served(folder: Path, port: int = 0, *, n_practice: int = 0) -> Iterator[HumanServer]:
    def open_sessions() -> HumanSessions:
        cfg = compose(["tuned=false", "env=TwoStep-v0", "env_kwargs.n_trials=3", "seed=7"])
        return HumanSessions(cfg, folder, n_practice=n_practice, n_blocks=1)

    with HumanServer(open_sessions, ("127.0.0.1", port), feedback_ms=0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "trials.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def begin(browser: Chromium, label: str = "Begin") -> None:
    browser.wait_for(f"document.body?.dataset.screen === '{label}'")
    browser.evaluate("document.querySelector('.go').click()")


def answer(browser: Chromium, number: int, key: str) -> None:
    browser.wait_for(f"document.body.dataset.number === '{number}' && !answered")
    browser.press(key)


def request(server: HumanServer, method: str, **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port)
    connection.request(method, "/join", b"{}", headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_other_sites_are_refused(tmp_path: Path) -> None:
    json_type = {"Content-Type": "application/json"}
    with served(tmp_path) as server:
        assert request(server, "POST", Host="evil.org:80", **json_type) == 403
        assert request(server, "GET", Host="evil.org:80") == 403
        assert request(server, "POST", **{"Content-Type": "text/plain"}) == 415
        assert request(server, "POST", **json_type) == 400
        assert request(server, "GET") == 404


@pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")
def test_a_person_plays_reloads_and_finishes(tmp_path: Path) -> None:
    with Chromium() as browser:
        with served(tmp_path, n_practice=1) as server:
            port = server.server_port
            browser.open(server.address)
            browser.wait_for("document.body.dataset.screen === 'Continue'")
            browser.evaluate("document.querySelector('input').value = 'p1'")
            browser.evaluate("document.querySelector('.go').click()")
            begin(browser, "Begin practice")
            assert "participant=p1" in browser.evaluate("location.search")
            answer(browser, 0, LEFT)
            answer(browser, 1, LEFT)
            begin(browser)  # what counts
            answer(browser, 2, LEFT)
            answer(browser, 3, RIGHT)
            browser.wait_for("document.body.dataset.number === '4' && !answered")
            browser.open(f"{server.address}?participant=p1&again")
            begin(browser, "Continue")
            answer(browser, 4, RIGHT)
            browser.wait_for("document.body.dataset.number === '5' && !answered")
        browser.press(LEFT)
        browser.wait_for("$('feedback').textContent.startsWith('No connection')")
        with served(tmp_path, port, n_practice=1):  # it does not know the window of the page
            browser.wait_for("document.body.dataset.refused === '409'")
            begin(browser, "Continue here")
            begin(browser, "Continue")
            answer(browser, 5, LEFT)
            answer(browser, 6, RIGHT)
            answer(browser, 7, RIGHT)
            browser.wait_for("document.body.dataset.screen === 'end'")
    table = rows(tmp_path)
    assert [row["response"] for row in table] == ["0", "1", "1", "0", "1", "1"]
    assert all(0 < float(row["rt_ms"]) < 30_000 and row["input"] == "key" for row in table)
    assert [row["n_shown"] for row in table[:3]] == ["1", "1", "2"]


@pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")
def test_of_two_windows_the_second_takes_over(tmp_path: Path) -> None:
    with served(tmp_path) as server, Chromium() as first, Chromium() as second:
        address = f"{server.address}?participant=p1"
        first.open(address)
        begin(first)
        answer(first, 0, LEFT)
        first.wait_for("document.body.dataset.number === '1' && !answered")
        second.open(address)
        begin(second, "Continue")
        second.wait_for("document.body.dataset.number === '1' && !answered")
        first.press(RIGHT)
        first.wait_for("document.body.dataset.refused === '409'")
        assert "another window" in first.evaluate("$('screen').textContent")
        second.evaluate("document.querySelectorAll('#options button')[1].click()")
        second.wait_for("document.body.dataset.number === '2'")
    assert [(row["response"], row["input"]) for row in rows(tmp_path)] == [
        ("0", "key"), ("1", "click"),
    ]  # fmt: skip
