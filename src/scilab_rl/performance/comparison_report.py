"""A comparison as tables, figures and one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import csv
import dataclasses
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl.errors import MissingDependencyError
from scilab_rl.files import atomic_write, write_json, write_text
from scilab_rl.performance.comparison import SUCCESS, Comparison, Contrast, Side
from scilab_rl.performance.estimates import Estimate, performance_profile

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, which colour-blind people tell apart.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
SIDE_COLUMNS = (
    "side", "runs", "crashed", "IQM", "mean", "median", "area under curve", "reached",
    "steps to threshold",
)  # fmt: skip
CONTRAST_COLUMNS = (
    "side", "against", "pairs", "IQM difference", "mean difference", "P(better)", "p", "verdict",
    "more seeds",
)  # fmt: skip
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 66rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; background: #fff; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { text-align: left; padding: .25rem .75rem; border-bottom: 1px solid #ddd;
         font-variant-numeric: tabular-nums; }
figure { margin: 2rem 0; } img { max-width: 100%; } figcaption, li { color: #555; }
"""


def side_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the table of the sides."""
    return [
        {
            "side": side.label,
            "runs": side.n_runs,
            "crashed": side.n_failed,
            "IQM": str(side.estimates["iqm"]),
            "mean": str(side.estimates["mean"]),
            "median": str(side.estimates["median"]),
            "area under curve": str(side.estimates["auc"]),
            "reached": f"{side.n_reached}/{side.n_runs}",
            "steps to threshold": _steps(side.estimates["steps"]),
        }
        for side in comparison.sides
    ]


def contrast_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the table of what tells the sides apart."""
    return [
        {
            "side": contrast.label,
            "against": comparison.sides[0].label,
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
    """Return in a sentence what was found about a side."""
    first = comparison.sides[0].label
    if contrast.verdict == "undecided":
        return (
            f"{contrast.label} and {first} cannot be told apart with {contrast.n} runs each "
            f"(p = {contrast.p:.2g}): about {contrast.more_seeds} more seeds of each would decide, "
            "if the difference is what it seems to be."
        )
    return (
        f"{contrast.label} is {contrast.verdict} than {first}: {contrast.mean} in the mean, "
        f"p = {contrast.p:.2g}."
    )


def write_reports(comparison: Comparison, folder: Path, *, parquet: bool = False) -> list[Path]:
    """Write everything into a folder and return the files.

    Args:
        comparison: What was found.
        folder: Made when missing.
        parquet: Whether the runs are written as Parquet too.

    Raises:
        MissingDependencyError: If Parquet is wanted and pyarrow is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    image = draw(comparison, folder / "comparison.png")
    draw(comparison, folder / "comparison.svg")
    write_text(folder / "comparison.html", page(comparison, image))
    write_text(folder / "comparison.md", markdown(comparison))
    write_json(folder / "comparison.json", as_json(comparison))
    write_table(comparison.runs, folder / "runs.csv")
    names = ["comparison.html", "comparison.png", "comparison.svg", "comparison.md"]
    names += ["comparison.json", "runs.csv"]
    if parquet:
        write_table(comparison.runs, folder / "runs.parquet")
        names.append("runs.parquet")
    return [folder / name for name in names]


def write_table(rows: Sequence[Any], path: Path) -> None:
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


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Return everything as plain data."""
    return {
        "metric": comparison.metric,
        "settings": dataclasses.asdict(comparison.settings),
        "tasks": list(comparison.tasks),
        "horizon": dict(comparison.horizon),
        "notes": list(comparison.notes),
        "sides": [
            {
                "label": side.label,
                "meaning": side.meaning,
                "scores": [task.tolist() for task in side.scores],
                "seeds": [list(task) for task in side.seeds],
                "n_reached": side.n_reached,
                "n_failed": side.n_failed,
                "estimates": {k: dataclasses.asdict(v) for k, v in side.estimates.items()},
                "curve": {
                    "steps": side.steps.tolist(),
                    **dict(zip(("iqm", "low", "high"), map(np.ndarray.tolist, side.band),
                               strict=True)),
                },
            }
            for side in comparison.sides
        ],
        "contrasts": [dataclasses.asdict(contrast) for contrast in comparison.contrasts],
        "runs": [dict(run) for run in comparison.runs],
    }  # fmt: skip


def markdown(comparison: Comparison) -> str:
    """Return the tables as GitHub shows them."""
    parts = [
        f"# {' and '.join(side.label for side in comparison.sides)}",
        _about(comparison),
        _markdown_table(SIDE_COLUMNS, side_rows(comparison)),
        _markdown_table(CONTRAST_COLUMNS, contrast_rows(comparison)),
        *(conclusion(comparison, contrast) for contrast in comparison.contrasts),
        "\n".join(f"* {note}" for note in comparison.notes),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def page(comparison: Comparison, image: Path) -> str:
    """Return one HTML file."""
    title = html.escape(" and ".join(side.label for side in comparison.sides))
    encoded = base64.b64encode(image.read_bytes()).decode()
    found = "".join(
        f"<p><b>{html.escape(conclusion(comparison, c))}</b></p>" for c in comparison.contrasts
    )
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in comparison.notes)
    runs = [{k: _shown(v) for k, v in run.items()} for run in comparison.runs]
    columns = list(dict.fromkeys(name for run in runs for name in run))
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>{found}"
        f"<p>{html.escape(_about(comparison))}</p>"
        f"{_html_table(SIDE_COLUMNS, side_rows(comparison))}"
        f"{_html_table(CONTRAST_COLUMNS, contrast_rows(comparison))}"
        f'<figure><img alt="curves and profiles" src="data:image/png;base64,{encoded}">'
        "<figcaption>Left: interquartile mean over runs with its 95 % bootstrap interval. Right: "
        "share of runs above a score.</figcaption></figure>"
        f"<ul>{notes}</ul><h2>All runs</h2>{_html_table(columns, runs)}</body></html>\n"
    )


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
    for side, colour in _coloured(comparison):
        value, low, high = side.band
        axes.plot(side.steps, value, color=colour, label=f"{side.label} ({side.n_runs} runs)")
        axes.fill_between(side.steps, low, high, color=colour, alpha=0.2, linewidth=0)
    one_length = len(set(comparison.horizon.values())) == 1
    axes.set_xlabel("environment steps" if one_length else "share of the training")
    axes.set_ylabel(comparison.metric)
    if comparison.metric == SUCCESS:
        axes.set_ylim(-0.03, 1.03)
    axes.legend(fontsize="small")


def _draw_profiles(comparison: Comparison, axes: Axes) -> None:
    together = np.concatenate([task for side in comparison.sides for task in side.scores])
    thresholds = np.linspace(together.min(), together.max(), 101)
    if comparison.metric == SUCCESS and comparison.settings.score != "steps_to_threshold":
        thresholds = np.linspace(0, 1, 101)
    for side, colour in _coloured(comparison):
        value, low, high = performance_profile(side.scores, thresholds)
        axes.plot(thresholds, value, color=colour, drawstyle="steps-post")
        axes.fill_between(thresholds, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set_xlabel(f"score ({comparison.settings.score})")
    axes.set_ylabel("share of runs above it")
    axes.set_ylim(-0.03, 1.03)


def _coloured(comparison: Comparison) -> list[tuple[Side, str]]:
    return [(s, _COLOURS[i % len(_COLOURS)]) for i, s in enumerate(comparison.sides)]


def _about(comparison: Comparison) -> str:
    settings = comparison.settings
    what = {
        "final": "mean of the last three evaluations",
        "auc": "mean over the training",
        "steps_to_threshold": "steps to the threshold",
    }[settings.score]
    tasks = ", ".join(f"{task} ({comparison.horizon[task]:,} steps)" for task in comparison.tasks)
    return (
        f"Score of a run: {what} of {comparison.metric}, threshold {settings.threshold:g}. Tasks: "
        f"{tasks}. In brackets: 95 % intervals of a bootstrap within tasks (Agarwal et al., 2021); "
        "p of a permutation test."
    )


def _steps(estimate: Estimate) -> str:
    return f"{estimate.value:,.0f} [{estimate.low:,.0f}, {estimate.high:,.0f}]"


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _markdown_table(columns: Sequence[str], rows: Sequence[Any]) -> str:
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    lines += [f"| {' | '.join(str(row[name]) for name in columns)} |" for row in rows]
    return "\n".join(lines)


def _html_table(columns: Sequence[str], rows: Sequence[Any]) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(str(row.get(n, '')))}</td>" for n in columns) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
