"""The outcome of performance tests, for people (Markdown, HTML) and for programs (JUnit, JSON)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from scilab_rl.acceptance.baselines import BaselineComparison
from scilab_rl.acceptance.conditions import REFERENCE
from scilab_rl.acceptance.results import ERROR, TestResult
from scilab_rl.acceptance.rules import FAIL, INCONCLUSIVE, PASS, Verdict
from scilab_rl.acceptance.runner import PerformanceTest
from scilab_rl.charts import Series
from scilab_rl.files import write_json, write_text
from scilab_rl.pages import as_cell, render

EXIT_PASS, EXIT_FAIL, EXIT_UNDECIDED = 0, 1, 3
_COLUMNS = ("test", "outcome", "mean", "interval", "target", "runs", "steps", "minutes", "baseline")


@dataclass(frozen=True)
class Outcome:
    """A test with its runs and verdict."""

    test: PerformanceTest
    result: TestResult
    verdict: Verdict
    comparison: BaselineComparison | None = None

    @property
    def seconds(self) -> float:
        """Wall time of all its runs, one after the other."""
        return math.fsum(run.seconds for run in self.result.runs.values())

    @property
    def errors(self) -> list[str]:
        """The errors of its failed runs."""
        return [run.error for run in self.result.in_order() if run.error]

    def row(self) -> dict[str, object]:
        """Return its line of the table."""
        runs = self.result.in_order()
        steps = [run.steps for run in runs if run.value is not None]
        target = self.test.conditions
        return {
            "test": self.test.name,
            "outcome": self.verdict.outcome,
            "mean": self.verdict.mean if math.isfinite(self.verdict.mean) else None,
            "interval": _interval(self.verdict),
            "target": f"{target.eval_value:g} ± {target.width:g}"
            if target.rule != REFERENCE
            else f"{target.eval_value:g} in {target.succ_runs} of {target.total_runs}",
            "runs": self.verdict.n_runs,
            "steps": f"{round(sum(steps) / len(steps)):,}" if steps else None,
            "minutes": round(self.seconds / 60, 1),
            "baseline": "; ".join(self.comparison.lines()) if self.comparison else None,
        }

    def explanation(self) -> str:
        """Return the meaning of the outcome as one sentence."""
        target, verdict = self.test.conditions, self.verdict
        if verdict.outcome == ERROR:
            return f"A run failed: {self.errors[0]}"
        if verdict.outcome == INCONCLUSIVE:
            return (
                f"After {verdict.n_runs} runs the mean {verdict.mean:.3g} {_interval(verdict)} "
                f"differs significantly neither from {target.eval_value - target.width:g} nor from "
                f"{target.eval_value:g}: the runs vary too much. Increase max_runs."
            )
        if target.rule == REFERENCE:
            return f"{target.succ_runs} of {target.total_runs} runs have to reach the target."
        claim = (
            f"above {target.eval_value - target.width:g}"
            if verdict.outcome == PASS
            else f"below {target.eval_value:g}"
        )
        return f"The mean over seeds is {claim}; at most {target.alpha:.0%} of tests are wrong."


def exit_code(outcomes: Iterable[Outcome]) -> int:
    """Return 0 if all pass, 1 if one fails or is worse, 3 if one is undecided or crashed."""
    code = EXIT_PASS
    for outcome in outcomes:
        worse = outcome.comparison is not None and outcome.comparison.worse
        if outcome.verdict.outcome == FAIL or worse:
            return EXIT_FAIL
        if outcome.verdict.outcome != PASS:
            code = EXIT_UNDECIDED
    return code


def write_reports(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """Write ``report.md``, ``.html``, ``.xml`` (JUnit) and ``.json``, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"report.{suffix}" for suffix in ("md", "html", "xml", "json")]
    write_text(paths[0], markdown(outcomes))
    write_text(paths[1], page(outcomes))
    write_text(paths[2], junit(outcomes))
    write_json(paths[3], [_as_json(outcome) for outcome in outcomes])
    return paths


def columns(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the columns of the table that are not empty."""
    rows = [outcome.row() for outcome in outcomes]
    return [name for name in _COLUMNS if any(row[name] is not None for row in rows)]


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the table as GitHub shows it."""
    names = columns(outcomes)
    lines = [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]
    for outcome in outcomes:
        cells = (as_cell(outcome.row()[name]).replace("|", "/") for name in names)
        lines.append(f"| {' | '.join(cells)} |")
    return "# Performance tests\n\n" + "\n".join(lines) + "\n"


def junit(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes in the format that continuous integration reads.

    A test without an answer counts as an error, which is not a failure of the algorithm.
    """
    suite = ElementTree.Element("testsuite", name="performance", tests=str(len(outcomes)))
    for outcome in outcomes:
        group, _, name = outcome.test.name.rpartition("/")
        case = ElementTree.SubElement(
            suite, "testcase", classname=f"performance.{group}", name=name,
            time=f"{outcome.seconds:.1f}",
        )  # fmt: skip
        worse = outcome.comparison is not None and outcome.comparison.worse
        if outcome.verdict.outcome == FAIL or worse:
            ElementTree.SubElement(case, "failure", message=_message(outcome))
        elif outcome.verdict.outcome != PASS:
            ElementTree.SubElement(
                case, "error", type=outcome.verdict.outcome, message=_message(outcome)
            )
        ElementTree.SubElement(case, "system-out").text = _message(outcome)
    suite.set("failures", str(len(suite.findall("testcase/failure"))))
    suite.set("errors", str(len(suite.findall("testcase/error"))))
    ElementTree.indent(suite)
    return ElementTree.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def page(outcomes: Sequence[Outcome]) -> str:
    """Return one self-contained HTML file with tables and curves."""
    names = columns(outcomes)
    rows = [[outcome.row()[name] for name in names] for outcome in outcomes]
    tests = [
        {
            "name": outcome.test.name,
            "outcome": outcome.verdict.outcome,
            "message": _message(outcome),
            "curves": _curves(outcome),
            "metric": outcome.test.conditions.eval_columns,
            "target": outcome.test.conditions.eval_value,
            "runs": [
                (
                    run.seed,
                    run.value,
                    f"{run.steps:,}",
                    round(run.seconds),
                    run.error or run.run_dir,
                )
                for run in outcome.result.in_order()
            ],
        }
        for outcome in outcomes
    ]
    title = "Performance tests"
    return render("performance.html", title=title, columns=names, rows=rows, tests=tests)


def _curves(outcome: Outcome) -> list[Series]:
    """Return the learning curves of all runs."""
    runs = [run for run in outcome.result.in_order() if run.curve]
    lines = [(list(run.curve_steps), list(run.curve)) for run in runs]
    return [Series("runs", lines)] if lines else []


def _message(outcome: Outcome) -> str:
    compared = outcome.comparison.lines() if outcome.comparison else ()
    return " ".join([f"{outcome.verdict.outcome}: {outcome.explanation()}", *compared])


def _interval(verdict: Verdict) -> str | None:
    if verdict.low is None or verdict.high is None:
        return None
    return f"[{verdict.low:.3g}, {verdict.high:.3g}]"


def _as_json(outcome: Outcome) -> dict[str, object]:
    row = outcome.row()
    return {
        "test": outcome.test.name,
        "env": outcome.test.env,
        "algorithm": outcome.test.algorithm,
        "outcome": outcome.verdict.outcome,
        "mean": row["mean"],
        "low": outcome.verdict.low,
        "high": outcome.verdict.high,
        "n_runs": outcome.verdict.n_runs,
        "seconds": round(outcome.seconds, 1),
        "explanation": outcome.explanation(),
        "conditions": dataclasses.asdict(outcome.test.conditions),
        "runs": [
            {"seed": run.seed, "value": run.value, "steps": run.steps, "error": run.error}
            for run in outcome.result.in_order()
        ],
        "baseline": dataclasses.asdict(outcome.comparison) if outcome.comparison else None,
    }
