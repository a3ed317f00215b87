"""Policies exported for a robot: how exactly they act as the agent, and how long an answer takes.

Exports each trained agent of the package as `scilab-rl export agent:NAME --policy DIR` does, in
10,000 observations each. Prints a table and one JSON object with, per agent,

* ``numpy`` and ``onnx``: the largest difference from the agent's own actions, as a share of half
  the action's range (bar: 1e-5);
* ``milliseconds``: median time of an answer of the runtime (bar: 0.5), and ``predict_milliseconds``
  that of the agent's own `predict`.

Run: python benchmarks/exported_policies.py [--agents NAME ...] [--observations N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

from scilab_rl.config.recorded import load_recorded
from scilab_rl.deployment.export import N_OBSERVATIONS, write_policy
from scilab_rl.run.directory import CONFIG_FILE, all_agents, find_policy, find_run
from scilab_rl.run.player import load_player

N_ANSWERS = 200


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--agents", nargs="+", default=sorted(all_agents()), metavar="NAME")
    parser.add_argument("--observations", type=int, default=N_OBSERVATIONS)
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    arguments = parser.parse_args()
    reports = {name: measure(name, arguments.observations) for name in arguments.agents}
    text = json.dumps({"agents": reports, "load_average": os.getloadavg()[0]}, indent=2)
    sys.stdout.write(f"{table(reports)}\n\n{text}\n")
    if arguments.json:
        arguments.json.write_text(text + "\n", encoding="utf-8")


def measure(name: str, n_observations: int) -> dict[str, object]:
    """Export an agent, and return its parity report with the time of its own answers."""
    run = find_run(f"agent:{name}", Path("data"))
    saved = find_policy(run, "finished")
    with tempfile.TemporaryDirectory() as folder:
        report = write_policy(run, saved, Path(folder) / name, n_observations=n_observations)
    cfg = load_recorded(run / CONFIG_FILE)
    env, model = load_player(cfg, saved, record=False)
    observation = env.reset()
    times = []
    for _ in range(N_ANSWERS):
        begin = time.perf_counter()
        model.predict(observation, deterministic=True)
        times.append(time.perf_counter() - begin)
    env.close()
    own = round(1e3 * statistics.median(times), 4)
    return {"algorithm": cfg.algorithm.name, **report, "predict_milliseconds": own}


def table(reports: dict[str, dict[str, object]]) -> str:
    """Return the table in Markdown."""
    rows = [
        "| agent | algorithm | NumPy | ONNX | an answer | `predict` |",
        "|---|---|---|---|---|---|",
    ]
    for name, report in reports.items():
        onnx = "-" if report["onnx"] is None else f"{report['onnx']:.1e}"
        rows.append(
            f"| {name} | `{report['algorithm']}` | {report['numpy']:.1e} | {onnx} | "
            f"{report['milliseconds']:.3f} ms | {report['predict_milliseconds']:.3f} ms |"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    main()
