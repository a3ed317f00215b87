"""The report of a study as one HTML file that needs nothing else."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from scilab_rl.charts import Interval, Series
from scilab_rl.pages import Link
from scilab_rl.pages import render as render_template
from scilab_rl.search.definition import ParameterDescription
from scilab_rl.search.plots import curves_by_configuration, mean_of_runs
from scilab_rl.search.runs import COMPLETE, FAILED, Run
from scilab_rl.search.scores import SCORES
from scilab_rl.search.summary import WINNER, ConfigurationRow, Summary
from scilab_rl.search.values import shown_text

_MOST_ROWS, _MOST_CURVES = 20, 4
_WINNER_COLOR, _OTHER_COLOR, _NEW_SEEDS_COLOR = 0, 5, 2
_FURTHER = ("Parallel", "Contour")  # pictures that say how parameters act together
_WIDE_GAP = 0.25  # of a range: so much without a trial is named


def render(summary: Summary, figures: Mapping[str, Path], folder: Path | None = None) -> str:
    """Return the page.

    Args:
        summary: What the study has found.
        figures: Caption to PNG file; those of several parameters go into the page.
        folder: Where the page will be, for links to runs.
    """
    names = list(summary.definition["space"])
    rates = summary.definition["criterion"].endswith("rate")
    is_rate = rates and summary.definition["score"][0] != "steps_to_threshold"
    return render_template(
        "study.html",
        title=summary.name,
        summary=summary,
        meanings=[(name, _meaning(name)) for name in summary.definition["score"]],
        intervals=list(_intervals(summary)),
        score_range=(0, 1) if is_rate else None,
        curve_range=(0, 1) if rates else None,
        importance=list(summary.importance.items()),
        effects=[effect for name in names if (effect := _effect(summary, name))],
        gaps=[(name, *_coverage(summary, name)) for name in names],
        curves=list(_curves(summary)),
        figures=[
            (caption, path.read_bytes())
            for caption, path in figures.items()
            if caption.startswith(_FURTHER)
        ],
        columns=["", *names, "runs", "score", ""],
        configurations=[_cells(row, names, bool(summary.front)) for row in summary.rows],
        failures=[
            (f"run {run.number}", f"#{run.trial}", run.error, _link(run, folder))
            for run in summary.runs
            if run.state == FAILED
        ],
    )


def _meaning(score: str) -> str:
    """Return what a score is, in a sentence."""
    doc = SCORES[score].__doc__ if score in SCORES else None
    first = (doc or "Your own function.").partition("\n")[0]
    return first.removeprefix("Return the ").replace("`", "")


def _link(run: Run, folder: Path | None) -> Link | str:
    if folder is None or not run.run_dir:
        return run.run_dir
    return Link(Path(run.run_dir).name, Path(os.path.relpath(run.run_dir, folder)).as_posix() + "/")


def _intervals(summary: Summary) -> Iterator[Interval]:
    """Yield the winner with new seeds, then the configurations, the best first."""
    if summary.final_mean is not None:
        mean, width = summary.final_mean, _finite(summary.final_half_width)
        label = "winner, new seeds"
        yield Interval(
            label, mean, mean - width, mean + width, summary.final_scores, color=_NEW_SEEDS_COLOR
        )
    for row in [row for row in summary.rows if row.mean is not None][:_MOST_ROWS]:
        assert row.mean is not None
        width = _finite(row.half_width)
        color = _WINNER_COLOR if row.verdict == WINNER else _OTHER_COLOR
        points = [run.scores[0] for run in _complete(summary) if run.trial == row.number]
        yield Interval(
            f"#{row.number}", row.mean, row.mean - width, row.mean + width, points,
            f"{row.interval}  {row.verdict}", color,
        )  # fmt: skip


def _effect(summary: Summary, name: str) -> dict[str, object] | None:
    """Return the chart of a parameter: score over numbers, or score of each choice."""
    described = summary.definition["space"][name]
    rows = [row for row in summary.rows if row.mean is not None and name in row.configuration]
    if not rows:
        return None
    if "low" in described:
        numbers = [float(row.configuration[name]) for row in rows]
        points = (numbers, [row.mean for row in rows])
        return {
            "name": name,
            "series": [Series("configurations", points=points)],
            "log": bool(described.get("log")),
            "range": (described["low"], described["high"]),
        }
    return {"name": name, "intervals": list(_choices(described, rows, name))}


def _choices(
    described: ParameterDescription, rows: Sequence[ConfigurationRow], name: str
) -> Iterator[Interval]:
    for choice in described.get("choices", []):
        same = [row for row in rows if row.configuration[name] == choice]
        means = [row.mean for row in same if row.mean is not None]
        if means:
            value = math.fsum(means) / len(means)
            text = f"{value:.3g}, {len(means)} configurations"
            yield Interval(shown_text(choice), value, min(means), max(means), means, text)


def _coverage(summary: Summary, name: str) -> tuple[str, str]:
    """Return what was tried of a parameter, and what never was."""
    described = summary.definition["space"][name]
    used = [row.configuration[name] for row in summary.rows if name in row.configuration]
    if "low" not in described:
        choices = described.get("choices", [])
        never = [shown_text(choice) for choice in choices if choice not in used]
        return f"{len(choices) - len(never)} of {len(choices)} choices", ", ".join(never) or "-"
    numbers = sorted({float(value) for value in used})
    low, high = float(described["low"]), float(described["high"])
    if not numbers:
        return "nothing", f"{low:.3g} to {high:.3g}"
    ends = [low, *numbers, high]
    scale = [math.log(end) for end in ends] if described.get("log") else ends
    whole = (scale[-1] - scale[0]) or 1.0
    gaps = [
        f"{ends[i]:.3g} to {ends[i + 1]:.3g}"
        for i in range(len(ends) - 1)
        if (scale[i + 1] - scale[i]) / whole > _WIDE_GAP
    ]
    tried = f"{len(numbers)} values, {numbers[0]:.3g} to {numbers[-1]:.3g}"
    return f"{tried} of {low:.3g} to {high:.3g}", ", ".join(gaps) or "-"


def _curves(summary: Summary) -> Iterator[Series]:
    """Yield the learning curves of the best configurations: each run, and their mean."""
    curves = curves_by_configuration(summary.runs)
    shown = [row for row in summary.rows if row.number in curves][:_MOST_CURVES]
    for color, row in enumerate(shown):
        runs = curves[row.number]
        lines = [(list(run.steps), list(run.values)) for run in runs]
        steps, means, _ = mean_of_runs(runs)
        yield Series(f"#{row.number} {row.verdict}", lines, (steps, means), color=color)


def _complete(summary: Summary) -> list[Run]:
    return [run for run in summary.runs if run.state == COMPLETE and not run.is_final]


def _finite(width: float) -> float:
    return width if math.isfinite(width) else 0.0


def _cells(row: ConfigurationRow, names: list[str], has_front: bool) -> list[object]:
    score = ", ".join(f"{value:.4g}" for value in row.values) if has_front else row.interval
    configuration = row.configuration
    values = (shown_text(configuration[name]) if name in configuration else "-" for name in names)
    return [f"#{row.number}", *values, row.n_runs, score, row.verdict]
