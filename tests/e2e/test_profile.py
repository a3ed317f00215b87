"""``scilab-rl profile`` tells where the time of a run goes."""

from __future__ import annotations

import json

import pytest

from tests.e2e.commands import TINY, scilab_rl


@pytest.mark.parametrize("algorithm", ["cleansac", "sac", "jaxsac"])
def test_the_parts_of_a_run_add_up(algorithm, tmp_path):
    if algorithm == "jaxsac":
        pytest.importorskip("jax")
    command = ["profile", TINY, f"algorithm={algorithm}", "eval_after_n_steps=150", "mlflow=0"]
    done = scilab_rl(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "data" / "last" / "profile.json").read_text())
    parts = figures["parts"]
    assert {"environment", "sampling", "update", "evaluation", "logging", "saving"} <= set(parts)
    assert figures["steps"] == 300
    assert parts["environment"]["n_calls"] == 300
    assert sum(part["seconds"] for part in parts.values()) == pytest.approx(figures["seconds"])
    assert "part\tseconds\tshare\tcalls\tms per call" in done.stdout
    assert "Most goes to" in done.stderr
