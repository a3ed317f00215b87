"""Draw success over steps from the figures of ``benchmarks/time_to_success.py``.

Lines are interquartile means over seeds, bands their 95 % bootstrap intervals. A run that has ended
because the task was mastered counts as if it had stayed where it was. Baselines of performance
tests can be given, too: their runs count as further seeds of the recipe of their algorithm.

    python benchmarks/time_to_success.py push --seeds 3 --json push.json
    python scripts/draw_time_to_success.py push.json baselines/FetchPush/jaxtd3_her-test.json \
        docs/images/learning_push.png
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from scilab_rl.analysis.estimates import curve_band


def main() -> None:
    """Draw one line per recipe."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("figures", type=Path, nargs="+", help="JSON files of the same environment")
    parser.add_argument("image", type=Path)
    options = parser.parse_args()
    recipes: dict[str, list[dict[str, Any]]] = {}
    for path in options.figures:
        env, curves_of = read_curves(path)
        for name, curves in curves_of.items():
            recipes.setdefault(name, []).extend(curves)
    figure, axis = plt.subplots(figsize=(6.4, 3.4))
    for name, curves in recipes.items():
        steps = max((curve["steps"] for curve in curves), key=len)
        value, low, high = curve_band([on_grid(curves, steps)])
        thousands = np.asarray(steps) / 1000
        axis.plot(thousands, value, label=f"{name} ({len(curves)} seeds)")
        axis.fill_between(thousands, low, high, alpha=0.2, linewidth=0)
    axis.set(
        title=env, xlabel="thousand environment steps", ylabel="success rate",
        ylim=(-0.03, 1.03), xlim=(0, None),
    )  # fmt: skip
    axis.axhline(0.9, color="0.5", linestyle="--", linewidth=1)
    axis.legend(loc="lower right", fontsize="small")
    figure.tight_layout()
    figure.savefig(options.image, dpi=110)


def read_curves(path: Path) -> tuple[str, dict[str, list[dict[str, Any]]]]:
    """Return the environment and the curves of each recipe."""
    report = json.loads(path.read_text(encoding="utf-8"))
    if "definition" not in report:
        curves = {n: [run["curve"] for run in runs] for n, runs in report["runs"].items()}
        return report["env"], curves
    tested = report["definition"]["configuration"]
    return json.loads(tested["env"]), {
        json.loads(tested["algorithm.name"]): [
            {"steps": run["curve_steps"], "success": run["curve"]} for run in report["runs"]
        ]
    }


def on_grid(curves: Sequence[dict[str, Any]], steps: Sequence[int]) -> np.ndarray:
    """Return success rates at the same steps; each stays at its last one.

    Shapes:
        result: ``(n_seeds, n_steps)``.
    """
    return np.array(
        [
            [*curve["success"], *[curve["success"][-1]] * (len(steps) - len(curve["steps"]))]
            for curve in curves
        ]
    )


if __name__ == "__main__":
    main()
