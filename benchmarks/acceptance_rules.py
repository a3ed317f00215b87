"""How often is a performance test wrong? Simulated error rates of its rules.

For each true success rate (the mean over seeds) tests are simulated as they would be run: a seed's
policy has a success rate of its own, drawn from a beta distribution around the true one (or, in
the world "collapse", from seeds that are all equally good but for some that learn nothing at all),
and is evaluated in episodes. The rules are

* ``reference``: 2 of 3 runs reach the value in an evaluation of 10 episodes;
* ``sequential``: the default, 100 episodes per run, spread of the runs estimated from the runs.

A rule is wrong when it passes at ``required - margin`` or below, or fails at ``required`` or above.
Prints a table; writes JSON and a figure.
Run: python benchmarks/acceptance_rules.py [--simulations N]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from scilab_rl.acceptance.rules import ReferenceRule, Rule, SequentialTest

TARGET = Path(__file__).parents[1] / "docs" / "images" / "acceptance_error_rates.png"
REQUIRED, MARGIN = 0.9, 0.1
RATES = (0.6, 0.65, 0.7, 0.75, 0.8, 0.825, 0.85, 0.875, 0.9, 0.925, 0.95, 0.975, 0.99)
RULES: dict[str, tuple[Rule, int]] = {
    "reference": (ReferenceRule(REQUIRED), 10),
    "sequential": (SequentialTest(REQUIRED, MARGIN), 100),
}
# How seeds differ: standard deviation of their success rates.
SPREADS = {"no spread": 0.0, "spread 0.05": 0.05, "spread 0.08": 0.08, "spread 0.12": 0.12}
COLLAPSE = "collapse"  # seeds that learn at all reach this, whatever the mean
GOOD_SEEDS = 0.99
COLORS = {"reference": "#999999", "sequential": "#d55e00"}


def draw_runs(
    world: str, rate: float, n_episodes: int, shape: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Return the measured success rates of runs. Shapes: result as ``shape``."""
    if world == COLLAPSE:
        policies = np.where(rng.random(shape) < rate / GOOD_SEEDS, GOOD_SEEDS, 0.0)
    else:
        # A beta distribution cannot be wider than its mean allows; U-shaped ones are no spread.
        variance = min(SPREADS[world] ** 2, rate * (1 - rate) / 2)
        if variance == 0:
            policies = np.full(shape, rate)
        else:
            concentration = rate * (1 - rate) / variance - 1
            policies = rng.beta(rate * concentration, (1 - rate) * concentration, shape)
    return rng.binomial(n_episodes, policies) / n_episodes


def simulate(n: int) -> list[dict[str, Any]]:
    """Return a row for each world, rule and true rate."""
    rng = np.random.default_rng(1)
    rows = []
    for world in (*SPREADS, COLLAPSE):
        for name, (rule, n_episodes) in RULES.items():
            for rate in RATES:
                runs = draw_runs(world, rate, n_episodes, (n, rule.max_runs), rng)
                codes, n_used = rule.outcomes(runs)
                rows.append(
                    {
                        "world": world,
                        "rule": name,
                        "true_rate": rate,
                        "pass": float((codes == 1).mean()),
                        "fail": float((codes == 2).mean()),
                        "inconclusive": float((codes == 3).mean()),
                        "mean_runs": float(n_used.mean()),
                    }
                )
    return rows


def draw(rows: list[dict[str, Any]]) -> None:
    """Draw how often each rule passes, a panel for each world."""
    worlds = [*SPREADS, COLLAPSE]
    figure, axes = plt.subplots(1, len(worlds), figsize=(3.1 * len(worlds), 3.2), sharey=True)
    for axis, world in zip(axes, worlds, strict=True):
        for name in RULES:
            of_it = [row for row in rows if row["world"] == world and row["rule"] == name]
            rates = [row["true_rate"] for row in of_it]
            axis.plot(rates, [r["pass"] for r in of_it], "o-", ms=3, color=COLORS[name], label=name)
        axis.axvspan(REQUIRED - MARGIN, REQUIRED, color="0.93", zorder=0)
        axis.axhline(0.05, color="0.6", lw=0.8, ls=":")
        axis.axhline(0.9, color="0.6", lw=0.8, ls=":")
        axis.set(title=world, xlabel="true success rate")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel(f"passes (required {REQUIRED})")
    axes[0].legend(fontsize=8, loc="upper left")
    figure.tight_layout()
    figure.savefig(TARGET, dpi=100)


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--simulations", type=int, default=10_000, help="per point; default 10000")
    n = parser.parse_args().simulations
    rows = simulate(n)
    shown = (REQUIRED - MARGIN, REQUIRED, 0.95)
    sys.stdout.write("world\trule\ttrue rate\tpass\tfail\tinconclusive\tmean runs\n")
    for row in rows:
        if row["true_rate"] in shown or abs(row["true_rate"] - shown[0]) < 1e-9:
            numbers = (f"{row[key]:.3f}" for key in ("pass", "fail", "inconclusive"))
            start = f"{row['world']}\t{row['rule']}\t{row['true_rate']}"
            sys.stdout.write("\t".join([start, *numbers, f"{row['mean_runs']:.1f}"]) + "\n")
    draw(rows)
    about = {"required": REQUIRED, "margin": MARGIN, "simulations": n}
    lines = ",\n  ".join(json.dumps(row) for row in rows)
    text = f'{{"about": {json.dumps(about)}, "rows": [\n  {lines}\n]}}\n'
    TARGET.with_suffix(".json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
