"""``scilab-rl performance [PATTERN ...]``: does everything still learn as well as it did?"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from scilab_rl.commands.parser import CommandParser, positive
from scilab_rl.commands.tables import print_json, print_rows
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)
_LOCAL = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}
_OPTIONAL = ("baseline", "interval", "steps", "minutes")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code: 0 passed, 1 failed, 3 undecided or crashed."""
    options = _parse(arguments)
    open_desk()
    from scilab_rl.performance.conditions import performance_tests, select, tier_of

    names = select(options.patterns, options.tier)
    if options.list:
        files = performance_tests()
        rows = [{"test": name, "tier": tier_of(files[name])} for name in names]
        print_json(rows) if options.json else print_rows(("test", "tier"), rows)
        return 0
    return _run(names, options)


def _run(names: list[str], options: argparse.Namespace) -> int:
    import hydra

    from scilab_rl.performance.report import columns, exit_code
    from scilab_rl.performance.session import Options, run_tests

    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        tests = [test for name in names if (test := _readable(name, options)) is not None]
    outcomes = run_tests(
        tests,
        Options(
            _LOCAL,
            n_jobs=options.jobs,
            fresh=options.fresh,
            any_code=options.any_code,
            baselines=options.baselines,
            write_baselines=options.write_baselines,
            output=options.output,
        ),
    )
    rows = [outcome.row() for outcome in outcomes]
    if options.json:
        print_json(rows)
    else:
        shown = columns(outcomes)
        print_rows(shown, rows, optional=[name for name in _OPTIONAL if name in shown])
    return exit_code(outcomes)


def _readable(name: str, options: argparse.Namespace) -> Any:
    """Compose a test; one whose packages are not installed is left out, and that is said."""
    from scilab_rl.errors import MissingDependencyError
    from scilab_rl.performance.campaign import read_test

    overrides = [f"+performance={name}", f"base_logdir={options.base_logdir}"]
    changes = {"rule": options.rule} if options.rule else {}
    try:
        return read_test(name, overrides, changes)
    except MissingDependencyError as error:
        if options.patterns:
            raise
        _log.warning("%s is left out: %s", name, error)
        return None


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("performance", "Run performance tests until each has its answer.")
    add = parser.add_argument
    add("patterns", nargs="*", help="parts of names, such as FetchReach; without one: all")
    add("--tier", choices=("pr", "nightly", "release"), help="minutes, hours, or all")
    add("--list", action="store_true", help="list the tests and do nothing")
    add("--jobs", type=positive, metavar="N", help="runs at a time; default: one per core")
    add("--rule", choices=("sequential", "bounded", "reference"), help="how to decide")
    add("--fresh", action="store_true", help="begin anew; otherwise unfinished tests go on")
    add("--any-code", action="store_true", help="keep runs that earlier code has trained")
    add("--baselines", type=Path, default=Path("baselines"), help="default: baselines")
    add("--write-baselines", action="store_true", help="let these results be the baselines")
    add("--output", type=Path, metavar="DIR", help="of the reports; default: data/performance")
    add("--base-logdir", type=Path, default=Path("data"), help="default: data")
    add("--json", action="store_true", help="print JSON")
    return parser.parse_args(arguments)
