"""``scilab-rl performance [PATTERN ...]``: test whether everything still learns as well."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.tables import print_rows
from scilab_rl.config.workspace import open_project

if TYPE_CHECKING:  # heavy
    from scilab_rl.acceptance.runner import PerformanceTest

_log = logging.getLogger(__name__)
_OPTIONAL = ("baseline", "interval", "steps", "minutes")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code: 0 passed, 1 failed, 3 undecided or crashed."""
    options = _parse(arguments)
    open_project()
    from scilab_rl.acceptance.conditions import select

    names = select(options.patterns, options.tier)
    if options.list:
        rows = [_listed(name, options.baselines) for name in names]
        print_rows(tuple(rows[0]), rows, as_json=options.json)
        return 0
    return _run(names, options)


def _listed(name: str, baselines: Path) -> dict[str, object]:
    """Return the row of a test: its tier, what it costs, and the result that is stored."""
    from scilab_rl.acceptance.baselines import read_baseline
    from scilab_rl.acceptance.conditions import performance_tests, stated

    path = performance_tests()[name]
    row: dict[str, object] = {"test": name, "tier": stated(path, "tier")}
    stored = read_baseline(name, baselines)
    if stored is None:
        return {**row, "hours": stated(path, "hours"), "stored": None}
    hours = sum(run.seconds for run in stored.in_order()) / 3600
    values = [run.value for run in stored.in_order() if run.value is not None]
    mean = f"{sum(values) / len(values):.3g} in {len(values)} runs"
    return {**row, "hours": float(f"{hours:.1g}"), "stored": mean}


def _run(names: list[str], options: argparse.Namespace) -> int:
    from scilab_rl.acceptance.report import columns, exit_code
    from scilab_rl.acceptance.session import run_tests
    from scilab_rl.parallel.launchers import read_launcher

    tests = [test for name in names if (test := _readable(name, options)) is not None]
    launcher = read_launcher(test.overrides for test in tests)
    outcomes = run_tests(
        tests,
        launcher,
        options.jobs,
        fresh=options.fresh,
        any_code=options.any_code,
        baselines=options.baselines,
        write_baselines=options.write_baselines,
        output=options.output,
    )
    rows = [outcome.row() for outcome in outcomes]
    print_rows(columns(outcomes), rows, optional=_OPTIONAL, as_json=options.json)
    return exit_code(outcomes)


def _readable(name: str, options: argparse.Namespace) -> PerformanceTest | None:
    """Compose a test; return None, and log why, if its packages are not installed."""
    from scilab_rl.acceptance.runner import read_test
    from scilab_rl.errors import MissingDependencyError

    overrides = [f"+performance={name}", f"base_logdir={options.base_logdir}"]
    try:
        return read_test(name, overrides, options.rule)
    except MissingDependencyError as error:
        if options.patterns:
            raise
        _log.warning("%s is skipped: %s", name, error)
        return None


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "performance", "Run performance tests until each is decided.", base=True, json=True
    )
    add = parser.add_argument
    add("patterns", nargs="*", help="parts of names, such as FetchReach; without one: all")
    add("--tier", choices=("pr", "nightly", "release"), help="minutes, hours, or all")
    add("--list", action="store_true", help="list the tests and do nothing")
    add("--jobs", type=positive, metavar="N", help="parallel runs; default: one per core")
    add("--rule", choices=("sequential", "reference"), help="how to decide")
    add(
        "--fresh",
        action="store_true",
        help="ignore existing results; otherwise unfinished tests continue",
    )
    add("--any-code", action="store_true", help="keep results of earlier code")
    add("--baselines", type=Path, default=Path("baselines"), help="default: baselines")
    add("--write-baselines", action="store_true", help="store these results as the baselines")
    add("--output", type=Path, metavar="DIR", help="of the reports; default: data/performance")
    return parser.parse_args(arguments)
