"""``scilab-rl export RUN --trials``: a tidy table for statistics and cognitive models."""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path
from typing import Any

from scilab_rl.commands.parser import CommandParser, positive
from scilab_rl.config import load_recorded
from scilab_rl.errors import ConfigError
from scilab_rl.results import CONFIG_FILE, RunDirectory, find_run
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_desk()
    from scilab_rl.performance.comparison_report import write_table

    run = find_run(options.run, options.base_logdir)
    cfg = load_recorded(run / CONFIG_FILE)
    rows = _training_episodes(run) if options.training else _trials(run, cfg, options)
    origin = {
        "run": run.path.name,
        "env": cfg.env,
        "algorithm": cfg.algorithm.name,
        "run_seed": cfg.seed,
    }
    kind = "training" if options.training else f"trials_{options.per}"
    path = options.output or run / f"{kind}.{options.format}"
    if path.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"--output must end in .csv or .parquet, but it is '{path}'.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_table([origin | row for row in rows], path)
    _log.info("%d rows: %s", len(rows), path)
    return 0


def _trials(run: RunDirectory, cfg: Any, options: argparse.Namespace) -> list[dict[str, Any]]:
    from scilab_rl.commands.play import load_player, policy_folder
    from scilab_rl.training.trials import by_episode, collect, softmax_choice

    env, model = load_player(cfg, policy_folder(run, options), record=False)
    seed = options.seed or int(cfg.seed) + 1
    choose = None
    if options.softmax is not None:
        choose = softmax_choice(model, options.softmax, seed)
    rows = collect(
        model, env, options.episodes, seed, choose=choose, most_dimensions=options.dimensions
    )
    env.close()
    return by_episode(rows) if options.per == "episode" else rows


def _training_episodes(run: RunDirectory) -> list[dict[str, Any]]:
    """Return the episodes that the run was trained with, as it has recorded them."""
    rows = []
    for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except ValueError:  # the last line of a killed run may be cut
            continue
        if row.pop("kind", None) == "episode":
            rows.append(row)
    return rows


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("export", "Write what an agent saw, did and thought as a tidy table.")
    add = parser.add_argument
    add("run", help="'last', the path of a run or policy, or a part of its name")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--trials", action="store_true", help="let its policy act, and write that (the default)"
    )
    what.add_argument(
        "--training", action="store_true", help="the episodes that it was trained with instead"
    )
    add("--per", choices=("step", "episode"), default="step", help="a row is; default: a step")
    add("--episodes", type=positive, default=20, help="default: 20")
    add("--policy", choices=("best", "finished"), default="finished")
    add(
        "--softmax",
        type=float,
        metavar="BETA",
        help="choose with probability proportional to exp(BETA Q), as a simulated participant",
    )
    add("--dimensions", type=positive, default=12, help="most numbers of an observation's parts")
    add("--seed", type=int, default=0, help="default: the run's seed plus 1")
    add("--format", choices=("csv", "parquet"), default="csv")
    add("--output", type=Path, metavar="FILE", help="default: inside the run's folder")
    add("--base-logdir", type=Path, default=Path("data"), help="default: data")
    return parser.parse_args(arguments)
