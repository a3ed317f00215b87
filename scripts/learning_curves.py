"""Draw how fast environments were learned, with the reference's thresholds: one panel each.

It reads the metrics of runs, for example of these, and writes the numbers beside the image:

    python src/main.py env=Reach1DOF-v0 seed=1 n_epochs=10 eval_after_n_steps=1000 \
      n_test_rollouts=20 info=curves
    python scripts/learning_curves.py --info curves
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import yaml

from scilab_rl.run.directory import CONFIG_FILE, all_runs, read_epochs

TARGET = Path(__file__).parents[1] / "docs" / "images" / "environments_learning.png"
N_COLUMNS = 4


@dataclass(frozen=True)
class Need:
    """What the reference's performance test asks for.

    Attributes:
        title: Of the panel.
        success: Success rate.
        steps: Steps within which it has to be reached; None where the reference has no test.
    """

    title: str
    success: float
    steps: int | None = None


NEEDS = {
    "Reach1DOF-v0": Need("Reach1DOF", 0.9),
    "Blocks-o0-gripper_random-v1": Need("Blocks, 0 blocks", 0.9, 10_000),
    "PointGym-sparse-0.5-small_open_dgr-c1-rt0-s500-v0": Need("PointMaze, small_open", 0.8, 25_000),
    "PointObjGym-sparse-o4-0.5-small_open_dgr-c1-rt0-s300-v0": Need(
        "PointObj, 4 objects", 0.8, 10_000
    ),
    "parking-limited-v0": Need("parking-limited", 0.8, 36_000),
    "CoppeliaReach-v0": Need("CoppeliaReach (stand-in)", 0.9),
    "CoppeliaDrive-v0": Need("CoppeliaDrive (stand-in)", 0.9),
}
Curve = dict[str, Any]


def collect(base: Path, info: str) -> dict[str, list[Curve]]:
    """Return the curves of the runs in a folder by environment: seed, steps, success.

    Args:
        base: Where runs live.
        info: The ``info`` of the runs that count; empty for all.
    """
    curves: dict[str, list[Curve]] = {}
    for run in all_runs(base):
        config = yaml.safe_load((run / CONFIG_FILE).read_text(encoding="utf-8"))
        epochs = read_epochs(run)
        if config["env"] not in NEEDS or not epochs or info not in ("", config["info"]):
            continue
        curve = {
            "seed": config["seed"],
            "algorithm": config["algorithm"]["name"],
            "episodes": config["n_test_rollouts"],
            "steps": [row["step"] for row in epochs],
            "success": [round(row["eval/success_rate"], 3) for row in epochs],
        }
        curves.setdefault(config["env"], []).append(curve)
    return {env_id: curves[env_id] for env_id in NEEDS if env_id in curves}


def reached_after(curve: Curve, success: float) -> int | None:
    """Return the steps after which an evaluation first was as good as needed, or None."""
    pairs = zip(curve["steps"], curve["success"], strict=True)
    return next((step for step, value in pairs if value >= success), None)


def draw(curves: dict[str, list[Curve]]) -> None:
    """Draw one panel for each environment."""
    n_rows = -(-len(curves) // N_COLUMNS)
    figure, axes = plt.subplots(
        n_rows, N_COLUMNS, figsize=(3.2 * N_COLUMNS, 2.7 * n_rows), squeeze=False, sharey=True
    )
    for axis in axes.flat[len(curves) :]:
        axis.axis("off")
    for axis, (env_id, of_env) in zip(axes.flat, curves.items(), strict=False):
        need = NEEDS[env_id]
        for curve in of_env:
            thousands = [step / 1000 for step in curve["steps"]]
            axis.plot(
                thousands,
                curve["success"],
                "o-",
                ms=3,
                label=f"{curve['algorithm']}, seed {curve['seed']}",
            )
        axis.axhline(need.success, color="0.4", ls="--", lw=1)
        limit = f", within {need.steps // 1000}k" if need.steps else ""
        axis.set_title(f"{need.title}\nneeded: {need.success}{limit}", fontsize=9)
        axis.set(ylim=(-0.03, 1.03), xlim=(0, None), xlabel="thousand steps")
        axis.legend(fontsize=7, loc="lower right")
    for row in axes:
        row[0].set_ylabel("success")
    figure.tight_layout()
    figure.savefig(TARGET, dpi=90)


def main() -> None:
    """Draw the image, write the numbers and tell what was reached."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base-logdir", type=Path, default=Path("data"), help="default: data")
    parser.add_argument("--info", default="", help="only runs with this info")
    options = parser.parse_args()
    curves = collect(options.base_logdir, options.info)
    if not curves:
        parser.error(f"no run in '{options.base_logdir}' is of one of: {', '.join(NEEDS)}")
    draw(curves)
    lines = [f"  {json.dumps(env_id)}: {json.dumps(of_env)}" for env_id, of_env in curves.items()]
    TARGET.with_suffix(".json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    for env_id, of_env in curves.items():
        for curve in of_env:
            after = reached_after(curve, NEEDS[env_id].success)
            told = f"after {after:,} steps" if after else f"not; best {max(curve['success'])}"
            sys.stdout.write(f"{env_id}, seed {curve['seed']}: {NEEDS[env_id].success} {told}\n")


if __name__ == "__main__":
    main()
