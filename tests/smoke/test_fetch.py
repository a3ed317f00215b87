"""The real robot simulator with each family of algorithms: does everything still run?"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.commands import last_run, scilab_rl

SHORT = ("eval_after_n_steps=120", "n_epochs=1", "n_test_rollouts=1", "mlflow=0", "seed=1")
SMALL = ("algorithm.batch_size=16",)


@pytest.mark.parametrize(
    "arguments",
    [
        ("algorithm=cleansac", "env=FetchPush-v4", "algorithm.buffer_size=500"),
        ("algorithm=td3", "env=FetchReach-v4", "algorithm.buffer_size=500"),
        ("algorithm=ppo", "env=FetchReachDense-v4", "algorithm.n_steps=64"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_algorithm_runs_on_fetch(arguments: tuple[str, ...], tmp_path: Path) -> None:
    done = scilab_rl(*arguments, *SHORT, *SMALL, "tuned=false", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((last_run(tmp_path) / "result.json").read_text())
    assert result["status"] == "finished"
    assert result["steps"] >= 120
    assert result["metrics"]["eval/mean_ep_length"] == 50
