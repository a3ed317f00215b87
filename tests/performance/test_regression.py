"""The guard does guard: an injected regression is found, and the intact algorithm passes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.commands import scilab_rl

pytestmark = pytest.mark.performance
TEST = "TinyReach/cleansac_her-test"


def outcome(folder: Path, *overrides: str) -> dict:
    """Run the test in a folder and return its line of the report."""
    scilab_rl(
        f"+performance={TEST}", "--multirun", "mlflow=0", *overrides, cwd=folder, timeout=3000
    )
    return json.loads((folder / "data" / "performance" / "report.json").read_text())[0]


def test_the_intact_algorithm_passes(tmp_path: Path) -> None:
    found = outcome(tmp_path)
    assert found["outcome"] == "pass", found


def test_a_target_network_that_never_follows_is_found(tmp_path: Path) -> None:
    """Measured when this was written: 0.73 where the intact algorithm reaches 1.0."""
    found = outcome(tmp_path, "++algorithm.tau=0.0")
    assert found["outcome"] == "fail", found
