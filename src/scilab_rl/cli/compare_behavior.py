"""``scilab-rl compare human.csv agent:NAME model:NAME``: what each does in the same task."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterable
from pathlib import Path

from scilab_rl.cli.fit import env_kwargs_of, require_jax
from scilab_rl.cli.parser import positive
from scilab_rl.cli.tables import print_json, print_rows
from scilab_rl.run.directory import slug

_log = logging.getLogger(__name__)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a comparison of behavior."""
    add = parser.add_argument
    add("--episodes", type=positive, default=20, help="of each agent; default: 20")
    add(
        "--softmax",
        type=float,
        metavar="BETA",
        help="agents choose with probability proportional to exp(BETA Q)",
    )
    add("--seed", type=int, default=0, help="of fitted and simulated models")


def report_folder(labels: Iterable[str], options: argparse.Namespace) -> Path:
    """Return the folder that gets the page of a comparison."""
    return options.output or options.base_logdir / "comparisons" / slug("-vs-".join(labels))


def show_behavior(options: argparse.Namespace) -> None:
    """Compare behavior, write the page and print the table.

    Args:
        options: Of ``scilab-rl compare``.
    """
    require_jax()
    from scilab_rl.analysis.fitting.behavior import behavior_rows, side_by_side, write_behavior
    from scilab_rl.api.behavior import BehaviorSettings, compare_behavior

    task, groups = compare_behavior(
        [word for word in options.groups if not word.startswith("env_kwargs.")],
        BehaviorSettings(
            env=options.env or "",
            env_kwargs=env_kwargs_of(options.groups),
            n_episodes=options.episodes,
            softmax=options.softmax,
            seed=options.seed,
        ),
        options.base_logdir,
    )
    page = write_behavior(groups, task, report_folder((group.label for group in groups), options))
    if options.json:
        print_json({"env": task, "behavior": behavior_rows(groups)})
    else:
        print_rows(*side_by_side(groups), prose=("behavior",))
    _log.info("%s", page)
