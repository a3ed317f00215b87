"""A project of its own for each test, and runs as training leaves them."""

import json
import sys
from pathlib import Path

import pytest
import yaml

from scilab_rl.results import RunResult
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder to work in; what is imported from it is forgotten afterwards."""
    (tmp_path / "conf").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in own_modules():
        monkeypatch.delitem(sys.modules, name)
    yield tmp_path
    for name in own_modules():
        del sys.modules[name]


def own_modules() -> list[str]:
    """Return the imported modules of a project folder, this repository's or a test's."""
    return [name for name in sys.modules if name.startswith("custom_")]


@pytest.fixture
def make_run(tmp_path):
    """Return a function that makes a run directory below ``tmp_path / "data"``."""

    def make(name: str, result: RunResult | None = None, **config) -> RunDirectory:
        path = tmp_path / "data" / "2026-01-02" / name
        path.mkdir(parents=True)
        run = RunDirectory(path)
        algorithm = {"name": "sac", "_target_": "stable_baselines3.SAC"}
        settings = {"env": "FetchReach-v4", "algorithm": algorithm, "seed": 7, **config}
        (run / CONFIG_FILE).write_text(yaml.safe_dump(settings), encoding="utf-8")
        if result is not None:
            run.write_result(result)
        return run

    return make


def write_file(path: Path, text: str) -> None:
    """Write a file of the project folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def read_table(text: str) -> list[dict[str, str]]:
    """Return the rows of tab-separated output."""
    heading, *lines = [line.split("\t") for line in text.splitlines()]
    return [dict(zip(heading, line, strict=True)) for line in lines]


def read_json(text: str) -> list[dict]:
    """Return the rows of JSON output."""
    return json.loads(text)
