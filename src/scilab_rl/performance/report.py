"""The outcome of performance tests, for people (Markdown, HTML) and for programs (JUnit, JSON)."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from scilab_rl.files import write_json, write_text
from scilab_rl.performance.baselines import Comparison
from scilab_rl.performance.campaign import PerformanceTest
from scilab_rl.performance.conditions import REFERENCE
from scilab_rl.performance.gate import FAIL, INCONCLUSIVE, PASS, Verdict
from scilab_rl.performance.results import ERROR, TestResult

EXIT_PASS, EXIT_FAIL, EXIT_UNDECIDED = 0, 1, 3
_COLUMNS = ("test", "outcome", "mean", "interval", "needed", "runs", "steps", "minutes", "baseline")
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; background: #fff; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { text-align: left; padding: .25rem .75rem; border-bottom: 1px solid #ddd;
         vertical-align: top; font-variant-numeric: tabular-nums; }
td.pass { color: #1a7f37; } td.fail, td.error { color: #b3261e; font-weight: 600; }
td.inconclusive { color: #9a6700; } details { margin: .5rem 0 1.5rem; } img { max-width: 100%; }
"""


@dataclass(frozen=True)
class Outcome:
    """A test, what its runs were, and what was decided."""

    test: PerformanceTest
    result: TestResult
    verdict: Verdict
    comparison: Comparison | None = None

    @property
    def seconds(self) -> float:
        """Wall time of all its runs, one after the other."""
        return math.fsum(run.seconds for run in self.result.runs.values())

    @property
    def errors(self) -> list[str]:
        """What its runs failed with."""
        return [run.error for run in self.result.in_order() if run.error]

    def row(self) -> dict[str, Any]:
        """Return its line of the table."""
        runs = self.result.in_order()
        steps = [run.steps for run in runs if run.value is not None]
        needed = self.test.conditions
        return {
            "test": self.test.name,
            "outcome": self.verdict.outcome,
            "mean": self.verdict.mean if math.isfinite(self.verdict.mean) else None,
            "interval": _interval(self.verdict),
            "needed": f"{needed.eval_value:g} ± {needed.width:g}"
            if needed.rule != REFERENCE
            else f"{needed.eval_value:g} in {needed.succ_runs} of {needed.total_runs}",
            "runs": self.verdict.n_runs,
            "steps": f"{round(sum(steps) / len(steps)):,}" if steps else None,
            "minutes": round(self.seconds / 60, 1),
            "baseline": "; ".join(self.comparison.lines()) if self.comparison else None,
        }

    def explanation(self) -> str:
        """Return in a sentence what the outcome means."""
        needed, verdict = self.test.conditions, self.verdict
        if verdict.outcome == ERROR:
            return f"A run failed: {self.errors[0]}"
        if verdict.outcome == INCONCLUSIVE:
            return (
                f"After {verdict.n_runs} runs the mean {verdict.mean:.3g} {_interval(verdict)} can "
                f"neither be told from {needed.eval_value - needed.width:g} nor from "
                f"{needed.eval_value:g}: the runs differ too much. A larger max_runs would decide."
            )
        if needed.rule == REFERENCE:
            return f"{needed.succ_runs} of {needed.total_runs} runs have to reach the value."
        claim = (
            f"above {needed.eval_value - needed.width:g}"
            if verdict.outcome == PASS
            else f"below {needed.eval_value:g}"
        )
        return f"The mean over seeds is {claim}, wrongly so in {needed.alpha:.0%} of tests at most."


def exit_code(outcomes: Iterable[Outcome]) -> int:
    """Return 0 when all pass, 1 when one fails or has worsened, 3 when one gave no answer."""
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
    """Return the columns of the table that say something."""
    rows = [outcome.row() for outcome in outcomes]
    return [name for name in _COLUMNS if any(row[name] is not None for row in rows)]


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the table as GitHub shows it."""
    names = columns(outcomes)
    lines = [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]
    for outcome in outcomes:
        cells = (_cell(outcome.row()[name]).replace("|", "/") for name in names)
        lines.append(f"| {' | '.join(cells)} |")
    return "# Performance tests\n\n" + "\n".join(lines) + "\n"


def junit(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes in the format that continuous integration reads.

    What gave no answer counts as an error: it is no failure of the algorithm, and no success.
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
    """Return one HTML file with tables and curves that needs nothing else."""
    names = columns(outcomes)
    head = "".join(f"<th>{name}</th>" for name in names)
    body = ""
    for outcome in outcomes:
        row = outcome.row()
        cells = "".join(
            f'<td class="{row["outcome"] if name == "outcome" else ""}">'
            f"{html.escape(_cell(row[name]))}</td>"
            for name in names
        )
        body += f"<tr>{cells}</tr>"
    details = "".join(map(_details, outcomes))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Performance tests</title><style>{_STYLE}</style></head><body>"
        f"<h1>Performance tests</h1><table><tr>{head}</tr>{body}</table>"
        "<p>The interval holds at whatever run a test stopped. Runs are the independent units; "
        f"each is the mean over the evaluation episodes of its policy.</p>{details}</body></html>\n"
    )


def _details(outcome: Outcome) -> str:
    rows = "".join(
        f"<tr><td>{run.seed}</td><td>{_cell(run.value)}</td><td>{run.steps:,}</td>"
        f"<td>{run.seconds:.0f}</td><td>{html.escape(run.error or run.run_dir)}</td></tr>"
        for run in outcome.result.in_order()
    )
    return (
        f"<h2>{html.escape(outcome.test.name)}: {outcome.verdict.outcome}</h2>"
        f"<p>{html.escape(_message(outcome))}</p>{_figure(outcome)}<details><summary>Runs</summary>"
        "<table><tr><th>seed</th><th>result</th><th>steps</th><th>seconds</th><th>folder</th></tr>"
        f"{rows}</table></details>"
    )


def _figure(outcome: Outcome) -> str:
    """Return the learning curves as an image inside the page."""
    curves = [(run.curve_steps, run.curve) for run in outcome.result.in_order() if run.curve]
    if not curves:
        return ""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 2.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    for steps, values in curves:
        axes.plot(steps, values, ".-", color="#0072b2", alpha=0.5)
    needed = outcome.test.conditions
    axes.axhline(needed.eval_value, color="#d55e00", linestyle="--", label="needed")
    axes.set(xlabel="environment steps", ylabel=needed.eval_columns, xlim=(0, None))
    axes.legend(fontsize="small")
    image = io.BytesIO()
    figure.savefig(image, dpi=100)
    encoded = base64.b64encode(image.getvalue()).decode()
    return f'<img alt="learning curves" src="data:image/png;base64,{encoded}">'


def _message(outcome: Outcome) -> str:
    told = [f"{outcome.verdict.outcome}: {outcome.explanation()}"]
    return " ".join([*told, *(outcome.comparison.lines() if outcome.comparison else ())])


def _interval(verdict: Verdict) -> str | None:
    if verdict.low is None or verdict.high is None:
        return None
    return f"[{verdict.low:.3g}, {verdict.high:.3g}]"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _as_json(outcome: Outcome) -> dict[str, Any]:
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
