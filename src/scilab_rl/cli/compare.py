"""``scilab-rl compare A B ...``: which group of runs learns better, and how sure is that?

With tables of choices or models among the groups, behavior is compared: see `compare_behavior`.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.analysis.fitting.words import names_choices
from scilab_rl.cli import compare_behavior
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_json, print_rows, write
from scilab_rl.errors import ConfigError

if TYPE_CHECKING:  # heavy
    from scilab_rl.analysis.groups import Group

_log = logging.getLogger(__name__)
# Options that mean nothing for the other kind of comparison.
_OF_RUNS, _OF_CHOICES = ("metric", "score", "threshold", "parquet"), ("episodes", "softmax", "seed")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    if any(map(names_choices, options.groups)):
        compare_behavior.show_behavior(options)
        return 0
    show(options.groups, options)
    return 0


def show(groups: Sequence[str | Group], options: argparse.Namespace) -> None:
    """Compare groups of runs, write the reports and print the tables.

    Args:
        groups: At least two.
        options: With the options that `add_options` adds.
    """
    from scilab_rl.analysis.report import (
        CONTRAST_COLUMNS,
        GROUP_COLUMNS,
        as_json,
        contrast_rows,
        group_rows,
    )
    from scilab_rl.api.comparison import compare

    summary = compare(
        *groups,
        env=options.env,
        metric=options.metric,
        score=options.score,
        threshold=options.threshold,
        base_logdir=options.base_logdir,
    )
    comparison = summary.comparison
    for note in comparison.notes:
        _log.warning("%s", note)
    folder = compare_behavior.report_folder((g.label for g in comparison.groups), options)
    paths = summary.save(folder, parquet=options.parquet)
    if options.json:
        print_json(as_json(comparison))
    else:
        print_rows(GROUP_COLUMNS, group_rows(comparison), optional=("crashed", "median", "reached"))
        print_rows(CONTRAST_COLUMNS, contrast_rows(comparison), optional=("pairs", "p"))
        for line in summary.conclusions:
            write(line)
    _log.info("%s", paths[0])


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a comparison."""
    add = parser.add_argument
    add("--metric", help="default: eval/success_rate, or eval/mean_reward where there is none")
    add(
        "--score",
        choices=("final", "auc", "steps_to_threshold"),
        default="final",
        help="one number per run; default: final, the mean of its last three evaluations",
    )
    add("--threshold", type=float, default=0.9, help="of steps_to_threshold; default: 0.9")
    add("--env", help="only this environment; without version: any version; * stands for any text")
    add("--output", type=Path, metavar="DIR", help="of the reports; default: data/comparisons")
    add("--parquet", action="store_true", help="also write the table of runs as Parquet")


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "compare",
        "Compare runs, studies, algorithms or groups of runs; or, with a table of choices or a "
        "model among them, what people, models and agents do in a choice task.",
        base=True,
        json=True,
    )
    parser.add_argument(
        "groups",
        nargs="+",
        metavar="GROUP",
        help="a run, study, group, algorithm, tag, or pattern as '*-sac-*'; choices.csv or "
        "model:NAME (with env_kwargs.KEY=VALUE); LABEL=GROUP names it",
    )
    add_options(parser)
    compare_behavior.add_options(parser)
    options = parser.parse_args(arguments)
    is_of_choices = any(map(names_choices, options.groups))
    misplaced = _OF_RUNS if is_of_choices else _OF_CHOICES
    given = [name for name in misplaced if getattr(options, name) != parser.get_default(name)]
    if given:
        raise ConfigError(
            f"--{given[0]} is for comparisons of {'runs' if is_of_choices else 'choices'}, and "
            f"these are {'choices' if is_of_choices else 'runs'}; leave it out."
        )
    return options
