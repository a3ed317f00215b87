"""From the names of performance tests to their reports, for the command and the sweeper."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scilab_rl.errors import ConfigError, SomeRunsFailedError
from scilab_rl.hyperopt.launchers import open_pool
from scilab_rl.performance.baselines import BASELINES, compare, read_baseline, write_baseline
from scilab_rl.performance.campaign import Campaign, PerformanceTest, read_test
from scilab_rl.performance.conditions import GROUP
from scilab_rl.performance.gate import FAIL, INCONCLUSIVE, PASS
from scilab_rl.performance.report import EXIT_FAIL, Outcome, exit_code, write_reports

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

_log = logging.getLogger(__name__)


class TestsFailedError(SomeRunsFailedError):
    """A performance test has failed, or has worsened since its baseline."""

    exit_code = EXIT_FAIL
    __test__ = False  # no test class of pytest


@dataclass(frozen=True)
class Options:
    """How tests are run.

    Attributes:
        launcher: The mapping ``hydra.launcher``.
        n_jobs: Runs at the same time; None means one per core.
        fresh: Whether to begin anew, whatever is known.
        any_code: Whether runs count that earlier code has trained.
        baselines: Folder of the baselines.
        write_baselines: Whether results of tests that have an answer become the baselines.
        output: Folder of the reports; None means ``performance`` below the folder of all runs.
    """

    launcher: Mapping[str, Any]
    n_jobs: int | None = None
    fresh: bool = False
    any_code: bool = False
    baselines: Path = BASELINES
    write_baselines: bool = False
    output: Path | None = None


def run_tests(tests: Sequence[PerformanceTest], options: Options) -> list[Outcome]:
    """Run tests, write their reports, and say where they are."""
    folder = options.output or tests[0].base / "performance"
    with open_pool(options.launcher, options.n_jobs, folder) as pool:
        campaign = Campaign(tests, pool, fresh=options.fresh, any_code=options.any_code)
        results = campaign.work()
    outcomes = []
    for test, result, rule in zip(tests, results, campaign.rules, strict=True):
        verdict = result.verdict(rule)
        old = read_baseline(test.name, options.baselines)
        comparison = compare(result, old) if old is not None else None
        if options.write_baselines and verdict.outcome in (PASS, FAIL, INCONCLUSIVE):
            _log.info("Baseline: %s", write_baseline(result, verdict, options.baselines))
        outcomes.append(Outcome(test, result, verdict, comparison))
    for path in write_reports(outcomes, folder):
        _log.info("%s", path)
    return outcomes


def run_from_sweep(
    sweeper: Mapping[str, Any], launcher: Mapping[str, Any], overrides: Sequence[Override]
) -> None:
    """Run the performance test that a multirun composes.

    Args:
        sweeper: The mapping ``hydra.sweeper``.
        launcher: The mapping ``hydra.launcher``.
        overrides: The command line.

    Raises:
        ConfigError: If it cannot work; nothing has been started.
        TestsFailedError: If the test has failed.
        SomeRunsFailedError: If it has no answer.
    """
    words = []
    for override in overrides:
        if override.is_sweep_override():
            raise ConfigError(
                f"A performance test takes one value of each key, but there is "
                f"{override.input_line}. Run it once for each."
            )
        words.append(override.input_line or "")
    words = [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    name = next(
        (w.partition("=")[2] for w in words if w.lstrip("+").startswith(f"{GROUP}=")), "performance"
    )
    tests = [read_test(name, words)]
    conclude(run_tests(tests, Options(launcher, sweeper.get("n_jobs"))))


def conclude(outcomes: Sequence[Outcome]) -> None:
    """Raise an error that says what did not pass, if anything did not."""
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
