"""``scilab-rl compare A B ...``: which group of runs learns better, and how sure is that?

With tables of choices or models among the groups, behavior is compared: see `compare_behavior`.
"""

from __future__ import annotations

import argparse
import functools
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.analysis.fitting.words import names_choices
from scilab_rl.cli import compare_behavior
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_json, print_rows, write
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import slug

if TYPE_CHECKING:  # heavy
    from scilab_rl.analysis.groups import Group

_log = logging.getLogger(__name__)
FOLDER = "comparisons"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    if any(map(names_choices, options.groups)):
        compare_behavior.show_behavior(options)
        return 0
    from scilab_rl.analysis.groups import find_group, read_records

    if len(options.groups) < 2:
        raise ConfigError("compare requires at least two groups, for example: compare sac sac_var")
    base = options.base_logdir
    records = functools.cache(lambda: read_records(base))
    groups = [find_group(word, records, base) for word in options.groups]
    show(groups, options)
    return 0


def show(groups: Sequence[Group], options: argparse.Namespace) -> None:
    """Compare groups of runs, write the reports and print the tables.

    Args:
        groups: At least two.
        options: With the options that `add_options` adds.
    """
    from scilab_rl.analysis.comparison import ComparisonSettings, compare
    from scilab_rl.analysis.report import (
        CONTRAST_COLUMNS,
        GROUP_COLUMNS,
        as_json,
        conclusion,
        contrast_rows,
        group_rows,
        write_reports,
    )

    if options.env:
        groups = [_only(group, options.env) for group in groups]
    comparison = compare(
        groups, ComparisonSettings(options.metric, options.score, options.threshold)
    )
    for note in comparison.notes:
        _log.warning("%s", note)
    name = slug("-vs-".join(group.label for group in groups))
    folder = options.output or options.base_logdir / FOLDER / name
    paths = write_reports(comparison, folder, parquet=options.parquet)
    if options.json:
        print_json(as_json(comparison))
    else:
        print_rows(GROUP_COLUMNS, group_rows(comparison), optional=("crashed", "median", "reached"))
        print_rows(CONTRAST_COLUMNS, contrast_rows(comparison), optional=("pairs", "p"))
        for contrast in comparison.contrasts:
            write(conclusion(comparison, contrast))
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
    add("--env", help="only this environment; without version: any version")
    add("--output", type=Path, metavar="DIR", help="of the reports; default: data/comparisons")
    add("--parquet", action="store_true", help="also write the table of runs as Parquet")


def _only(group: Group, env: str) -> Group:
    import dataclasses
    import re

    def family(name: str) -> str:
        return re.sub(r"-v\d+$", "", name)

    runs = tuple(run for run in group.runs if env in (run.env, family(run.env)))
    if not runs:
        raise ConfigError(f"{group.label} has no run in {env}.")
    return dataclasses.replace(group, runs=runs)


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
    return parser.parse_args(arguments)
