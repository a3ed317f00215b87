"""Choosing and showing recorded episodes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from scilab_rl.cli import view
from scilab_rl.errors import ConfigError
from scilab_rl.run.recordings import chosen_recordings, recordings_of

NAMES = ("train_epoch_0001_episode_00000", "eval_epoch_0001_episode_00000", "play_001")


@pytest.fixture
def run(make_run: Any) -> Any:
    """A run with three recordings and one that was probed later."""
    run = make_run("120000-run")
    (run / "episodes").mkdir()
    for age, name in enumerate([*NAMES, "play_001_probe"]):
        for suffix in (".npz", ".html", ".rrd"):
            path = run / "episodes" / f"{name}{suffix}"
            path.touch()
            os.utime(path, (1000 + age, 1000 + age))
    return run


def stems(paths: list[Path]) -> list[str]:
    return [path.stem for path in paths]


def test_by_number_by_name_the_last_and_all_but_probed(run: Any) -> None:
    assert stems(chosen_recordings(run, "2")) == [NAMES[1]]
    assert stems(chosen_recordings(run, "play_001")) == ["play_001"]
    assert stems(chosen_recordings(run, "last")) == ["play_001_probe"]
    assert stems(chosen_recordings(run, "all")) == list(NAMES)


def test_episode_that_does_not_exist(run: Any) -> None:
    with pytest.raises(ConfigError, match=r"no episode 'play_01'\. Did you mean 'play_001'"):
        chosen_recordings(run, "play_01")
    with pytest.raises(ConfigError, match=r"no episode '5'\. There are 1 to 4"):
        chosen_recordings(run, "5")


def test_run_without_recordings_says_how_to_make_one(make_run: Any) -> None:
    with pytest.raises(ConfigError, match=r"Train with render=record, or .* play .* --record"):
        recordings_of(make_run("120000-run"))


@pytest.mark.parametrize(
    ("has_display", "in_browser", "expected"),
    [(True, False, "window"), (True, True, "page"), (False, False, "served")],
)
def test_window_page_or_server(
    run: Any, monkeypatch: pytest.MonkeyPatch, has_display: bool, in_browser: bool, expected: str
) -> None:
    pytest.importorskip("rerun")
    opened: list[tuple[str, str]] = []

    class Window:
        def __init__(self, source: str) -> None:
            opened.append(("window", source))

        def wait(self) -> None:
            pass

    monkeypatch.setattr(view, "has_display", lambda: has_display)
    monkeypatch.setattr(view, "Window", Window)
    monkeypatch.setattr(view, "_serve", lambda page: opened.append(("served", str(page))))
    monkeypatch.setattr("webbrowser.open", lambda uri: opened.append(("page", uri)) or True)
    view.show(run / "episodes" / "play_001.npz", in_browser=in_browser)
    assert [how for how, _ in opened] == [expected]
    assert "play_001" in opened[0][1]
