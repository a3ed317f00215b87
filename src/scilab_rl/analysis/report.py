"""A comparison as tables, figures and one self-contained HTML file."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.analysis.comparison import (
    Comparison,
    Contrast,
    GroupEstimates,
    mean_curve,
)
from scilab_rl.analysis.estimates import N_SAMPLES, Estimate, performance_profile
from scilab_rl.analysis.groups import SUCCESS
from scilab_rl.charts import Interval, Series
from scilab_rl.drawing import COLORS
from scilab_rl.errors import MissingDependencyError
from scilab_rl.files import atomic_write, write_json, write_text
from scilab_rl.pages import Link, render

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SCORES = {
    "final": "mean of the last three evaluations",
    "auc": "mean over the training",
    "steps_to_threshold": "steps to the threshold",
}
GROUP_COLUMNS = (
    "group", "runs", "crashed", "IQM", "mean", "median", "area under curve", "reached",
    "steps to threshold",
)  # fmt: skip
CONTRAST_COLUMNS = (
    "group", "compared with", "pairs", "IQM difference", "mean difference", "P(better)", "p",
    "verdict", "more seeds",
)  # fmt: skip


def group_rows(comparison: Comparison) -> list[dict[str, object]]:
    """Return the table of the groups."""
    return [
        {
            "group": group.label,
            "runs": group.n_runs,
            "crashed": group.n_failed,
            "IQM": str(group.estimates["iqm"]),
            "mean": str(group.estimates["mean"]),
            "median": str(group.estimates["median"]),
            "area under curve": str(group.estimates["auc"]),
            "reached": f"{group.n_reached}/{group.n_runs}",
            "steps to threshold": _steps(group.estimates["steps"]),
        }
        for group in comparison.groups
    ]


def contrast_rows(comparison: Comparison) -> list[dict[str, object]]:
    """Return the table of the differences between groups."""
    return [
        {
            "group": contrast.label,
            "compared with": comparison.groups[0].label,
            "pairs": str(contrast.n) if contrast.paired else f"none ({contrast.n} runs)",
            "IQM difference": str(contrast.iqm),
            "mean difference": str(contrast.mean),
            "P(better)": str(contrast.improvement),
            "p": round(contrast.p, 4),
            "verdict": contrast.verdict,
            "more seeds": contrast.more_seeds,
        }
        for contrast in comparison.contrasts
    ]


def conclusion(comparison: Comparison, contrast: Contrast) -> str:
    """Return the conclusion about a group as one sentence."""
    first = comparison.groups[0].label
    if contrast.verdict == "undecided":
        return (
            f"{contrast.label} and {first} do not differ significantly with {contrast.n} runs "
            f"each (p = {contrast.p:.2g}): about {contrast.more_seeds} more seeds of each would "
            "decide, if the true difference is the observed one."
        )
    return (
        f"{contrast.label} is {contrast.verdict} than {first}: mean difference {contrast.mean}, "
        f"p = {contrast.p:.2g}."
    )


def write_reports(comparison: Comparison, folder: Path, *, parquet: bool = False) -> list[Path]:
    """Write all reports into a folder and return their paths.

    Args:
        comparison: The comparison.
        folder: Created if missing.
        parquet: Whether the runs are written as Parquet too.

    Raises:
        MissingDependencyError: If Parquet is requested and pyarrow is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    draw(comparison, folder / "comparison.png")
    draw(comparison, folder / "comparison.svg")
    write_text(folder / "comparison.html", page(comparison, folder))
    write_text(folder / "comparison.md", markdown(comparison))
    write_json(folder / "comparison.json", as_json(comparison))
    write_table(comparison.runs, folder / "runs.csv")
    names = ["comparison.html", "comparison.png", "comparison.svg", "comparison.md"]
    names += ["comparison.json", "runs.csv"]
    if parquet:
        write_table(comparison.runs, folder / "runs.parquet")
        names.append("runs.parquet")
    return [folder / name for name in names]


def write_table(rows: Sequence[Mapping[str, object]], path: Path) -> None:
    """Write rows as CSV or, by the suffix ``.parquet``, as Parquet; missing values stay empty.

    Raises:
        MissingDependencyError: If pyarrow is needed and not installed.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row))
    if path.suffix == ".parquet":
        try:
            import pyarrow
            from pyarrow import parquet
        except ImportError as error:
            raise MissingDependencyError("pyarrow", "parquet", "to write Parquet") from error
        table = pyarrow.table({name: [row.get(name) for row in rows] for name in columns})
        atomic_write(path, lambda file: parquet.write_table(table, file))
        return
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def as_json(comparison: Comparison) -> dict[str, object]:
    """Return the comparison as plain data."""
    return {
        "metric": comparison.metric,
        "settings": dataclasses.asdict(comparison.settings),
        "tasks": list(comparison.tasks),
        "horizon": dict(comparison.horizon),
        "notes": list(comparison.notes),
        "groups": [
            {
                "label": group.label,
                "meaning": group.meaning,
                "scores": [task.tolist() for task in group.scores],
                "seeds": [list(task) for task in group.seeds],
                "n_reached": group.n_reached,
                "n_failed": group.n_failed,
                "estimates": {k: dataclasses.asdict(v) for k, v in group.estimates.items()},
                "curve": {
                    "steps": group.steps.tolist(),
                    **dict(zip(("iqm", "low", "high"), map(np.ndarray.tolist, group.band),
                               strict=True)),
                },
            }
            for group in comparison.groups
        ],
        "contrasts": [dataclasses.asdict(contrast) for contrast in comparison.contrasts],
        "runs": [dict(run) for run in comparison.runs],
    }  # fmt: skip


def markdown(comparison: Comparison) -> str:
    """Return the tables as GitHub shows them."""
    parts = [
        f"# {' and '.join(group.label for group in comparison.groups)}",
        _about(comparison),
        _markdown_table(GROUP_COLUMNS, group_rows(comparison)),
        _markdown_table(CONTRAST_COLUMNS, contrast_rows(comparison)),
        *(conclusion(comparison, contrast) for contrast in comparison.contrasts),
        "\n".join(f"* {note}" for note in comparison.notes),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def page(comparison: Comparison, folder: Path) -> str:
    """Return one HTML file, whose links to runs hold in a folder."""
    is_rate = _is_rate(comparison)
    return render(
        "comparison.html",
        title=_listed([group.label for group in comparison.groups]),
        conclusions=[conclusion(comparison, contrast) for contrast in comparison.contrasts],
        contrasts=[
            Interval(
                f"{contrast.label} − {comparison.groups[0].label}",
                contrast.mean.value, contrast.mean.low, contrast.mean.high,
                text=f"{contrast.mean}, p = {contrast.p:.2g}: {contrast.verdict}", color=number,
            )
            for number, contrast in enumerate(comparison.contrasts, start=1)
        ],
        groups=[
            Interval(
                group.label, estimate.value, estimate.low, estimate.high,
                points=np.concatenate(list(group.scores)).tolist(), color=number,
            )
            for number, group in enumerate(comparison.groups)
            for estimate in (group.estimates["iqm"],)
        ],
        score=_score_name(comparison),
        score_range=(0, 1) if is_rate else None,
        curves=[_series(comparison, group, n) for n, group in enumerate(comparison.groups)],
        x_label="environment steps" if comparison.has_one_length else "share of the training",
        metric=comparison.metric,
        metric_range=(0, 1) if comparison.metric == SUCCESS else None,
        labels=[group.label for group in comparison.groups],
        differences=comparison.differences,
        notes=comparison.notes,
        methods=methods(comparison),
        tables=(
            _table(GROUP_COLUMNS, group_rows(comparison)),
            _table(CONTRAST_COLUMNS, contrast_rows(comparison)),
        ),
        runs=_narrow_table(comparison, folder),
    )  # fmt: skip


def methods(comparison: Comparison) -> str:
    """Return what a paper says about how the groups were compared."""
    settings = comparison.settings
    counts = _listed([f"{group.label} ({group.n_runs} runs)" for group in comparison.groups])
    tasks = ", ".join(f"{task} ({comparison.horizon[task]:,} steps)" for task in comparison.tasks)
    score = _SCORES[settings.score] + (
        f" of {settings.threshold:g}" if settings.score == "steps_to_threshold" else ""
    )
    is_paired = all(contrast.paired for contrast in comparison.contrasts)
    several = " with Holm's correction" if len(comparison.contrasts) > 1 else ""
    return (
        f"We compared {counts} on {tasks}. The score of a run is the {score} of "
        f"{comparison.metric}. We report interquartile means over runs with 95 % intervals of a "
        f"stratified bootstrap ({N_SAMPLES:,} samples; Agarwal et al., 2021), and p values of a "
        f"two-sided permutation test {'paired by seed' if is_paired else 'of unpaired runs'}"
        f"{several}."
    )


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _series(comparison: Comparison, group: GroupEstimates, number: int) -> Series:
    as_share = not comparison.has_one_length
    lines = [
        ([step / (curve.budget if as_share else 1) for step in curve.steps], list(curve.values))
        for curve in group.curves
    ]
    name = f"{group.label} ({group.n_runs} runs)"
    return Series(name, lines, mean_curve(group.curves, as_share=as_share), color=number)


def _narrow_table(comparison: Comparison, folder: Path) -> tuple[list[str], list[list[object]]]:
    """Return the runs with their scores; the complete table is in ``runs.csv``."""
    score = comparison.settings.score
    several = len(comparison.tasks) > 1
    rows = []
    for run in comparison.runs:
        path = Path(str(run["run"]))
        address = Path(os.path.relpath(path, folder)).as_posix()
        cells: list[object] = [run["group"], *([run["env"]] if several else []), run["seed"]]
        rows.append([*cells, run.get(score), run["status"], Link(path.name, f"{address}/")])
    return ["group", *(["env"] if several else []), "seed", score, "status", "run"], rows


def _is_rate(comparison: Comparison) -> bool:
    return comparison.metric == SUCCESS and comparison.settings.score != "steps_to_threshold"


def _score_name(comparison: Comparison) -> str:
    return f"{comparison.metric}, {_SCORES[comparison.settings.score]}"


def draw(comparison: Comparison, path: Path) -> Path:
    """Draw curves and performance profiles, as PNG or SVG by the suffix."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    _draw_curves(comparison, left)
    _draw_profiles(comparison, right)
    with matplotlib.rc_context({"svg.hashsalt": "scilab-rl"}):  # the same data, the same file
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(path, dpi=120, metadata=metadata)
    return path


def _draw_curves(comparison: Comparison, axes: Axes) -> None:
    for number, (group, color) in enumerate(_with_colors(comparison)):
        series = _series(comparison, group, number)
        for steps, values in series.lines:
            axes.plot(steps, np.array(values, float), ".-", color=color, alpha=0.3, lw=0.8, ms=3)
        assert series.mean is not None
        axes.plot(*map(np.array, series.mean), color=color, lw=2, label=series.name)
    one_length = comparison.has_one_length
    axes.set_xlabel("environment steps" if one_length else "share of the training")
    axes.set_ylabel(comparison.metric)
    if comparison.metric == SUCCESS:
        axes.set_ylim(-0.03, 1.03)
    axes.legend(fontsize="small")


def _draw_profiles(comparison: Comparison, axes: Axes) -> None:
    together = np.concatenate([task for group in comparison.groups for task in group.scores])
    thresholds = np.linspace(together.min(), together.max(), 101)
    if _is_rate(comparison):
        thresholds = np.linspace(0, 1, 101)
    for group, color in _with_colors(comparison):
        value, low, high = performance_profile(group.scores, thresholds)
        axes.plot(thresholds, value, color=color, drawstyle="steps-post")
        axes.fill_between(thresholds, low, high, color=color, alpha=0.2, linewidth=0)
    axes.set_xlabel(f"score ({comparison.settings.score})")
    axes.set_ylabel("share of runs above it")
    axes.set_ylim(-0.03, 1.03)


def _with_colors(comparison: Comparison) -> list[tuple[GroupEstimates, str]]:
    return [(s, COLORS[i % len(COLORS)]) for i, s in enumerate(comparison.groups)]


def _about(comparison: Comparison) -> str:
    settings = comparison.settings
    meaning = _SCORES[settings.score]
    tasks = ", ".join(f"{task} ({comparison.horizon[task]:,} steps)" for task in comparison.tasks)
    return (
        f"Score of a run: {meaning} of {comparison.metric}, threshold {settings.threshold:g}. "
        f"Tasks: {tasks}. Brackets: 95 % intervals of a bootstrap within tasks (Agarwal et al., "
        "2021). p: permutation test."
    )


def _steps(estimate: Estimate) -> str:
    return f"{estimate.value:,.0f} [{estimate.low:,.0f}, {estimate.high:,.0f}]"


def _table(
    columns: Sequence[str], rows: Sequence[Mapping[str, object]]
) -> tuple[Sequence[str], list[list[object]]]:
    return columns, [[row.get(name, "") for name in columns] for row in rows]


def _markdown_table(columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> str:
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    lines += [f"| {' | '.join(str(row[name]) for name in columns)} |" for row in rows]
    return "\n".join(lines)
