"""Run directories as a training leaves them, without the training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import yaml

from scilab_rl.results import RunResult
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory

STEPS = 100


def make_run(
    base: Path,
    algorithm: str,
    seed: int,
    curve: Sequence[float],
    *,
    env: str = "FetchReach-v4",
    status: str = "finished",
    group: str | None = None,
    tags: Sequence[str] = (),
    n_epochs: int | None = None,
    fingerprint: str = "abc",
    metric: str = "eval/success_rate",
    reward_type: str | None = None,
    **parameters: object,
) -> RunDirectory:
    """Write the files of a run with these evaluations."""
    run = RunDirectory.create(base, env, algorithm, seed)
    env_kwargs = {} if reward_type is None else {"reward_type": reward_type}
    config = {
        "env": env, "env_kwargs": env_kwargs, "wrappers": [], "seed": seed, "group": group,
        "tags": list(tags), "algorithm": {"name": algorithm, **parameters},
        "n_epochs": n_epochs or len(curve), "eval_after_n_steps": STEPS,
    }  # fmt: skip
    (run / CONFIG_FILE).write_text(yaml.safe_dump(config))
    (run / "provenance.json").write_text(json.dumps({"fingerprint": fingerprint, "versions": {}}))
    rows = [
        {"kind": "epoch", "step": STEPS * (i + 1), metric: value, "eval/mean_reward": value}
        for i, value in enumerate(curve)
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    run.write_result(RunResult(status, 0.0, len(curve), STEPS * len(curve), 5.0, str(run)))
    return run
