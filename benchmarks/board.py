"""The board of many runs: size of the page, time to write it, and time until Chromium shows it.

The runs are made up, in a temporary folder: environments, algorithms, changed keys, seeds, a study,
60 evaluations with 25 metrics each. The page is opened in headless Chromium, from the disk.

Prints one JSON object (bars: 15 MB, 2 s with 1,000 runs).

Run: python benchmarks/board.py [--runs N] [--keep FOLDER] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
_ENVS = ("FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4", "Blocks-o1-gripper_above-v1")
_ALGORITHMS = ("jaxsac", "cleansac", "sac", "td3")
_CHANGES = ({}, {"gamma": 0.9}, {"learning_rate": 0.001}, {"gamma": 0.9, "tau": 0.01})
_METRICS = (
    "eval/success_rate", "eval/mean_reward", "eval/mean_ep_length", "rollout/success_rate",
    "rollout/ep_rew_mean", "train/critic_loss", "train/actor_loss", "train/entropy",
    *(f"train/number_{index}" for index in range(13)), "time/fps", "time/train_seconds",
    "time/eval_seconds", "time/total_timesteps",
)  # fmt: skip
_FILES = ("curve.png", "train.log", "episodes/eval_0060_0.html", "episodes/eval_0060_0.mp4")


def make_runs(base: Path, n_runs: int, n_epochs: int = 60) -> None:
    """Write the files of runs that never took place.

    Args:
        base: The folder of all runs.
        n_runs: How many. A fifth of them belongs to a study.
        n_epochs: Evaluations of each.
    """
    chance = random.Random(1)
    n_study = n_runs // 5
    if n_study:
        (base / "studies" / "wide").mkdir(parents=True)
        (base / "studies" / "wide" / "study.yaml").write_text("{}\n")
        (base / "studies" / "wide" / "report.html").write_text("<!doctype html>")
    for index in range(n_runs):
        repeat, kind = index % 5, index // 5
        of_study = index >= n_runs - n_study
        env = _ENVS[kind % 4]
        name = _ALGORITHMS[(kind // 4) % 4]
        changes = dict(_CHANGES[(kind // 16) % 4])
        if kind >= 64 or of_study:
            changes["batch_size"] = 64 + kind
        folder = base / f"2026-01-{1 + index // 80:02d}"
        path = folder / f"{8 + index % 12:02d}{index % 60:02d}00-{env}-{name}-s{repeat}-{index:04x}"
        (path / "episodes").mkdir(parents=True)
        algorithm = {"name": name, "_target_": "x.X", "gamma": 0.95, "tau": 0.005, **changes}
        if kind % 7 == 3:
            algorithm["intrinsic"] = {"name": "rnd", "weight": 0.1}
        config = {
            "env": env, "algorithm": algorithm, "seed": repeat, "n_epochs": n_epochs,
            "eval_after_n_steps": 2000, "group": "wide" if of_study else None,
            "tags": ["thesis"] if kind % 9 == 0 else None,
        }  # fmt: skip
        (path / "config.yaml").write_text(json.dumps(config))
        rows = list(_rows(chance, kind, n_epochs))
        lines = [json.dumps({"kind": "epoch", **row}) for row in rows]
        (path / "metrics.jsonl").write_text("\n".join(lines) + "\n")
        status = "failed" if index % 41 == 7 else "solved" if index % 13 == 1 else "finished"
        result = {
            "status": status, "score": None, "epochs": n_epochs, "steps": rows[-1]["step"],
            "seconds": 300.0 + index, "run_dir": str(path), "metrics": rows[-1],
            "error": "NaN in the critic" if status == "failed" else None,
        }  # fmt: skip
        (path / "result.json").write_text(json.dumps(result))
        words = [
            f"algorithm={name}",
            f"env={env}",
            *(f"algorithm.{k}={v}" for k, v in changes.items()),
        ]
        (path / "provenance.json").write_text(json.dumps({"overrides": words, "fingerprint": None}))
        for file in _FILES:
            (path / file).touch()


def _rows(chance: random.Random, kind: int, n_epochs: int) -> Iterator[dict[str, float]]:
    """Yield a learning curve: it rises at a time and to a height that the kind of run decides."""
    height = 0.35 + 0.65 * ((kind * 37) % 17) / 16
    middle = n_epochs * (0.2 + 0.5 * ((kind * 13) % 11) / 10) + chance.gauss(0, n_epochs / 20)
    for epoch in range(1, n_epochs + 1):
        success = height / (1 + math.exp(-(epoch - middle) * 10 / n_epochs))
        success = round(min(max(success + chance.gauss(0, 0.04), 0), 1) * 20) / 20
        values = {name: round(chance.gauss(0, 1), 5) for name in _METRICS}
        values |= {"eval/success_rate": success, "eval/mean_reward": round(-50 + 45 * success, 3)}
        yield {"epoch": epoch, "step": 2000 * epoch, **values}


def measure(base: Path) -> dict[str, float]:
    """Write the board of a folder, open it, and return what it took."""
    sys.path.insert(0, str(ROOT))
    from tests.e2e.chromium import Chromium

    from scilab_rl.analysis.board import write_board

    started = time.perf_counter()
    page = write_board(base)
    numbers = {
        "write_seconds": time.perf_counter() - started,
        "megabytes": page.stat().st_size / 1e6,
    }
    with Chromium() as browser:
        browser.open(page.as_uri())
        browser.wait_for("document.body.dataset.ready")
        timing = "performance.timing.loadEventEnd - performance.timing.navigationStart"
        browser.wait_for("performance.timing.loadEventEnd > 0")
        numbers["load_seconds"] = browser.evaluate(timing) / 1000
        numbers["ready_seconds"] = float(browser.evaluate("document.body.dataset.ready")) / 1000
    return numbers


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--keep", type=Path, help="folder for the runs; default: a temporary one")
    parser.add_argument("--json", type=Path, help="file for the figures, too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        base = options.keep or Path(temporary) / "data"
        if not base.exists():
            make_runs(base, options.runs)
        text = json.dumps({"runs": options.runs, **measure(base)}, indent=2) + "\n"
    sys.stdout.write(text)
    if options.json:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
