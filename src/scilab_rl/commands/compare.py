"""``scilab-rl compare A B ...``: which side learns better, and how sure is that?"""

from __future__ import annotations

import argparse
import functools
import logging
from pathlib import Path
from typing import Any

from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import print_json, print_rows, write
from scilab_rl.errors import ConfigError
from scilab_rl.results import slug

_log = logging.getLogger(__name__)
FOLDER = "comparisons"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    from scilab_rl.performance.groups import find_group, read_records

    if len(options.sides) < 2:
        raise ConfigError("compare needs at least two sides, for example: compare sac sac_var")
    base = options.base_logdir
    records = functools.cache(lambda: read_records(base))
    groups = [find_group(word, records, base) for word in options.sides]
    show(groups, options)
    return 0


def show(groups: Any, options: argparse.Namespace) -> None:
    """Compare groups of runs, write the reports and print the tables.

    Args:
        groups: The sides.
        options: With the options that `add_options` adds.
    """
    from scilab_rl.performance.comparison import Settings, compare
    from scilab_rl.performance.comparison_report import (
        CONTRAST_COLUMNS,
        SIDE_COLUMNS,
        as_json,
        conclusion,
        contrast_rows,
        side_rows,
        write_reports,
    )

    if options.env:
        groups = [_only(group, options.env) for group in groups]
    comparison = compare(groups, Settings(options.metric, options.score, options.threshold))
    for note in comparison.notes:
        _log.warning("%s", note)
    name = slug("-vs-".join(group.label for group in groups))
    folder = options.output or options.base_logdir / FOLDER / name
    paths = write_reports(comparison, folder, parquet=options.parquet)
    if options.json:
        print_json(as_json(comparison))
    else:
        print_rows(SIDE_COLUMNS, side_rows(comparison), optional=("crashed", "median", "reached"))
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
        help="a run as one number; default: final, the mean of its last three evaluations",
    )
    add("--threshold", type=float, default=0.9, help="for the steps to it; default: 0.9")
    add("--env", help="only this environment; without version: any version")
    add("--output", type=Path, metavar="DIR", help="of the reports; default: data/comparisons")
    add("--parquet", action="store_true", help="write the table of the runs as Parquet too")
    add("--base-logdir", type=Path, default=Path("data"), help="default: data")
    add("--json", action="store_true", help="print JSON")


def _only(group: Any, env: str) -> Any:
    import dataclasses
    import re

    def family(name: str) -> str:
        return re.sub(r"-v\d+$", "", name)

    runs = tuple(run for run in group.runs if env in (run.env, family(run.env)))
    if not runs:
        raise ConfigError(f"{group.label} has no run in {env}.")
    return dataclasses.replace(group, runs=runs)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("compare", "Compare runs, studies, algorithms or groups of runs.")
    parser.add_argument(
        "sides",
        nargs="+",
        metavar="SIDE",
        help="a run, study, group, algorithm, tag, or pattern as '*-sac-*'; LABEL=SIDE names it",
    )
    add_options(parser)
    return parser.parse_args(arguments)
