"""Run performance tests and report them, for the command and the sweeper."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scilab_rl.acceptance.baselines import BASELINES, compare, read_baseline, write_baseline
from scilab_rl.acceptance.conditions import GROUP
from scilab_rl.acceptance.report import EXIT_FAIL, Outcome, exit_code, write_reports
from scilab_rl.acceptance.rules import FAIL, INCONCLUSIVE, PASS
from scilab_rl.acceptance.runner import PerformanceTest, PerformanceTestRunner, read_test
from scilab_rl.errors import ConfigError, SomeRunsFailedError
from scilab_rl.parallel.launchers import open_pool

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

_log = logging.getLogger(__name__)


class TestsFailedError(SomeRunsFailedError):
    """A performance test failed, or is worse than its baseline."""

    exit_code = EXIT_FAIL
    __test__ = False  # not a test class of pytest


def run_tests(
    tests: Sequence[PerformanceTest],
    launcher: Mapping[str, object],
    n_jobs: int | None = None,
    *,
    fresh: bool = False,
    any_code: bool = False,
    baselines: Path = BASELINES,
    write_baselines: bool = False,
    output: Path | None = None,
) -> list[Outcome]:
    """Run tests, write their reports, and log the paths.

    Args:
        tests: At least one test.
        launcher: The mapping ``hydra.launcher``.
        n_jobs: Parallel runs; None means one per core.
        fresh: Whether to ignore existing results.
        any_code: Whether to keep results of earlier code.
        baselines: Folder of the baselines.
        write_baselines: Whether decided tests become the baselines.
        output: Folder of the reports; None means ``performance`` below the folder of all runs.
    """
    folder = output or tests[0].base / "performance"
    with open_pool(launcher, n_jobs, folder) as pool:
        runner = PerformanceTestRunner(tests, pool, fresh=fresh, any_code=any_code)
        results = runner.work()
    outcomes = []
    for test, result, rule in zip(tests, results, runner.rules, strict=True):
        verdict = result.verdict(rule)
        old = read_baseline(test.name, baselines)
        comparison = compare(result, old) if old is not None else None
        if write_baselines and verdict.outcome in (PASS, FAIL, INCONCLUSIVE):
            _log.info("Baseline: %s", write_baseline(result, verdict, baselines))
        outcomes.append(Outcome(test, result, verdict, comparison))
    for path in write_reports(outcomes, folder):
        _log.info("%s", path)
    return outcomes


def run_from_sweep(
    sweeper: Mapping[str, Any], launcher: Mapping[str, object], overrides: Sequence[Override]
) -> None:
    """Run the performance test that a multirun composes.

    Args:
        sweeper: The mapping ``hydra.sweeper``.
        launcher: The mapping ``hydra.launcher``.
        overrides: The command line.

    Raises:
        ConfigError: If the command line is invalid; nothing has been started.
        TestsFailedError: If the test failed.
        SomeRunsFailedError: If it is undecided.
    """
    words = []
    for override in overrides:
        if override.is_sweep_override():
            raise ConfigError(
                f"A performance test takes one value of each key, but "
                f"{override.input_line} was given. Run it once for each value."
            )
        words.append(override.input_line or "")
    words = [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    name = next(
        (w.partition("=")[2] for w in words if w.lstrip("+").startswith(f"{GROUP}=")), "performance"
    )
    tests = [read_test(name, words)]
    raise_for_outcome(run_tests(tests, launcher, sweeper.get("n_jobs")))


def raise_for_outcome(outcomes: Sequence[Outcome]) -> None:
    """Raise an error if a test did not pass.

    Raises:
        TestsFailedError: If a test failed.
        SomeRunsFailedError: If a test is undecided.
    """
    bad = [o for o in outcomes if exit_code([o])]
    if not bad:
        for outcome in outcomes:
            _log.info("%s: pass. %s", outcome.test.name, outcome.explanation())
        return
    first = bad[0]
    message = (
        f"{len(bad)} of {len(outcomes)} performance tests did not pass, first {first.test.name} "
        f"({first.verdict.outcome}): {first.explanation()}"
    )
    raise (TestsFailedError if exit_code(outcomes) == EXIT_FAIL else SomeRunsFailedError)(message)
