"""The report of a study as one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from scilab_rl.pages import render as render_template
from scilab_rl.search.runs import FAILED
from scilab_rl.search.summary import ConfigurationRow, Summary
from scilab_rl.search.values import shown_text


def render(summary: Summary, figures: Mapping[str, Path]) -> str:
    """Return the page.

    Args:
        summary: What the study has found.
        figures: Caption to PNG file; the images go into the page.
    """
    names = list(summary.definition["space"])
    return render_template(
        "study.html",
        title=summary.name,
        summary=summary,
        figures=[(caption, path.read_bytes()) for caption, path in figures.items()],
        columns=["", *names, "runs", "score", ""],
        configurations=[_cells(row, names, bool(summary.front)) for row in summary.rows],
        failures=[
            (f"run {run.number}", f"#{run.trial}", run.error, run.run_dir)
            for run in summary.runs
            if run.state == FAILED
        ],
    )


def _cells(row: ConfigurationRow, names: list[str], has_front: bool) -> list[object]:
    score = ", ".join(f"{value:.4g}" for value in row.values) if has_front else row.interval
    configuration = row.configuration
    values = (shown_text(configuration[name]) if name in configuration else "-" for name in names)
    return [f"#{row.number}", *values, row.n_runs, score, row.verdict]
