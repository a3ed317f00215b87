"""The plots of a study, as PNG files, drawn by Matplotlib without a screen."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scilab_rl.drawing import COLORS
from scilab_rl.search.runs import COMPLETE, FAILED, PRUNED, Run
from scilab_rl.search.summary import BEATEN, CONTENDER, WINNER, ConfigurationRow, Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLORS = {WINNER: COLORS[0], CONTENDER: COLORS[5], BEATEN: "#999999"}
_OTHER = "#cccccc"
_MOST_CURVES = 6


def draw_all(summary: Summary, directory: Path) -> dict[str, Path]:
    """Draw what can be drawn of a study.

    Args:
        summary: What the study has found.
        directory: Where the PNG files go.

    Returns:
        Caption to file, in the order of interest.
    """
    import matplotlib

    matplotlib.use("Agg")
    directory.mkdir(exist_ok=True)
    drawings: dict[str, tuple[str, Callable[[Summary, Axes], bool]]] = {
        "Mean score with its interval, and each run": ("configurations", draw_configurations),
        "Learning curves: mean over seeds with its standard error": ("curves", draw_curves),
        "History: each run in the order of its start": ("history", draw_history),
        "Importance: what of the differences each parameter explains": (
            "importance", draw_importance,
        ),
        "Parallel coordinates: each line is a configuration": ("parallel", draw_parallel),
        "Contour: the two most important parameters": ("contour", draw_contour),
    }  # fmt: skip
    figures = {}
    for caption, (name, draw) in drawings.items():
        path = directory / f"{name}.png"
        if _save(draw, summary, path):
            figures[caption] = path
        else:
            path.unlink(missing_ok=True)
    return figures


def draw_configurations(summary: Summary, axes: Axes) -> bool:
    """Draw one line per configuration, the best on top."""
    rows = [row for row in summary.rows if row.mean is not None][:20]
    scores = _scores_by_configuration(summary.runs)
    for y, row in enumerate(rows):
        assert row.mean is not None
        color, width = _color(row), _drawable(row.half_width)
        axes.plot(scores[row.number], [y] * row.n_runs, ".", color=color, alpha=0.5)
        axes.errorbar(row.mean, y, xerr=width, fmt="o", color=color, capsize=3)
    if summary.final_mean is not None:
        axes.errorbar(
            summary.final_mean, -0.35, xerr=_drawable(summary.final_half_width), fmt="D",
            color=COLORS[2], capsize=3, label="winner, new seeds",
        )  # fmt: skip
        axes.legend()
    axes.set_yticks(range(len(rows)), [_short(row) for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.7)
    axes.set_xlabel(_score_label(summary))
    return bool(rows)


def draw_curves(summary: Summary, axes: Axes) -> bool:
    """Draw the evaluations of the best configurations over training."""
    curves = curves_by_configuration(summary.runs)
    shown = [row for row in summary.rows if row.number in curves][:_MOST_CURVES]
    for row in shown:
        steps, means, errors = mean_of_runs(curves[row.number])
        (line,) = axes.plot(steps, means, label=_short(row))
        axes.fill_between(
            steps,
            [m - e for m, e in zip(means, errors, strict=True)],
            [m + e for m, e in zip(means, errors, strict=True)],
            color=line.get_color(),
            alpha=0.2,
            linewidth=0,
        )
    axes.set_xlabel("environment steps")
    axes.set_ylabel(summary.definition["criterion"])
    if shown:
        axes.legend(fontsize="small")
    return bool(shown)


def draw_history(summary: Summary, axes: Axes) -> bool:
    """Draw the score of each run in the order of their start."""
    winner = summary.winner
    groups: dict[str, tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
    for run in summary.runs:
        if run.state == COMPLETE:
            group = "winner, new seeds" if run.is_final else "run"
            if winner is not None and run.trial == winner.number and not run.is_final:
                group = "winner"
            groups[group][0].append(run.number)
            groups[group][1].append(run.scores[0])
    colors = {"run": _COLORS[BEATEN], "winner": _COLORS[WINNER], "winner, new seeds": COLORS[2]}
    for group, (numbers, scores) in groups.items():
        axes.plot(numbers, scores, "o", color=colors[group], label=group)
    for state, mark in ((FAILED, "x"), (PRUNED, "v")):
        numbers = [run.number for run in summary.runs if run.state == state]
        if numbers and groups:
            lowest = [axes.get_ylim()[0]] * len(numbers)
            axes.plot(numbers, lowest, mark, color="black", label=state, clip_on=False)
    axes.set_xlabel("run")
    axes.set_ylabel(_score_label(summary))
    if groups:
        axes.legend(fontsize="small")
    return bool(groups)


def draw_importance(summary: Summary, axes: Axes) -> bool:
    """Draw one bar per parameter."""
    names = list(summary.importance)[::-1]
    axes.barh(names, [summary.importance[name] for name in names], color=_COLORS[CONTENDER])
    axes.set_xlim(0, 1)
    return len(names) > 1


def draw_parallel(summary: Summary, axes: Axes) -> bool:
    """Draw each configuration as a line through its values, scaled from 0 to 1."""
    names = list(summary.definition["space"])
    rows = [row for row in summary.rows if row.mean is not None]
    if len(names) < 2 or len(rows) < 2:
        return False
    columns = [_positions(summary, name, rows) for name in names]
    means = _unit([row.mean or 0.0 for row in rows])
    for i in reversed(range(len(rows))):  # the winner on top
        heights = [column[i] for column in columns]
        axes.plot([*heights, means[i]], color=_color(rows[i]), alpha=0.8)
    labels = [f"{_last(name)}\n{_range(summary, name, rows)}" for name in names]
    scores = [row.mean for row in rows if row.mean is not None]
    labels.append(f"score\n{min(scores):.3g} … {max(scores):.3g}")
    axes.set_xticks(range(len(names) + 1), labels)
    axes.set_yticks([0, 1], ["lowest", "highest"])
    return True


def draw_contour(summary: Summary, axes: Axes) -> bool:
    """Draw the mean score over the two numeric parameters that matter most."""
    numeric = [n for n in summary.importance if "low" in summary.definition["space"].get(n, {})]
    rows = [r for r in summary.rows if r.mean is not None and {*numeric[:2]} <= {*r.configuration}]
    if len(numeric) < 2 or len(rows) < 4:
        return False
    # Logarithms as coordinates: a triangulation of the raw values overlaps itself on log axes.
    (x, x_label), (y, y_label) = (_coordinates(summary, name, rows) for name in numeric[:2])
    means = [row.mean or 0.0 for row in rows]
    if len(set(x)) > 2 and len(set(y)) > 2:
        try:
            axes.tricontourf(x, y, means, levels=12, cmap="viridis", alpha=0.6)
        except (RuntimeError, ValueError):  # all points on a line
            pass
    points = axes.scatter(x, y, c=means, cmap="viridis", edgecolors="black", clip_on=False)
    figure: Any = axes.figure
    figure.colorbar(points, ax=axes, label=_score_label(summary))
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    return True


def _save(draw: Callable[[Summary, Axes], bool], summary: Summary, path: Path) -> bool:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    drawn = draw(summary, axes)
    if drawn:
        figure.savefig(path, dpi=110)
    return drawn


def _scores_by_configuration(runs: Iterable[Run]) -> dict[int, list[float]]:
    scores = defaultdict(list)
    for run in runs:
        if run.state == COMPLETE and not run.is_final:
            scores[run.trial].append(run.scores[0])
    return scores


def curves_by_configuration(runs: Iterable[Run]) -> dict[int, list[Run]]:
    """Return the complete runs of the search that were evaluated, by configuration."""
    curves = defaultdict(list)
    for run in runs:
        if run.state == COMPLETE and not run.is_final and run.values:
            curves[run.trial].append(run)
    return curves


def mean_of_runs(runs: Sequence[Run]) -> tuple[list[int], list[float], list[float]]:
    """Return steps, means and standard errors; a run that stopped early stays at its last value."""
    steps = max((run.steps for run in runs), key=len)
    columns = [[run.values[min(i, len(run.values) - 1)] for run in runs] for i in range(len(steps))]
    means = [math.fsum(column) / len(column) for column in columns]
    errors = [
        math.sqrt(
            math.fsum((v - m) ** 2 for v in column) / max(len(column) - 1, 1) / len(column)
        )
        for column, m in zip(columns, means, strict=True)
    ]  # fmt: skip
    return list(steps), means, errors


def _coordinates(
    summary: Summary, name: str, rows: Sequence[ConfigurationRow]
) -> tuple[list[float], str]:
    """Return a parameter's values as they are drawn, and the label of their axis."""
    values = [float(row.configuration[name]) for row in rows]
    if summary.definition["space"][name].get("log"):
        return [math.log10(value) for value in values], f"log10 of {_last(name)}"
    return values, _last(name)


def _range(summary: Summary, name: str, rows: Sequence[ConfigurationRow]) -> str:
    """Return the ends of a parameter's axis, as `_positions` scales it."""
    described = summary.definition["space"][name]
    values = [row.configuration[name] for row in rows if name in row.configuration]
    if choices := described.get("choices"):
        used = [choice for choice in choices if choice in values] or choices
        return f"{used[0]} … {used[-1]}"
    numbers = [float(value) for value in values] or [described["low"]]
    return f"{min(numbers):.3g} … {max(numbers):.3g}"


def _positions(summary: Summary, name: str, rows: Sequence[ConfigurationRow]) -> list[float]:
    described = summary.definition["space"][name]
    values = [row.configuration.get(name) for row in rows]
    if described.get("choices"):
        places = [described["choices"].index(v) if v in described["choices"] else 0 for v in values]
        return _unit([float(place) for place in places])
    numbers = [float(described["low"] if value is None else value) for value in values]
    return _unit([math.log(n) if described.get("log") else n for n in numbers])


def _unit(values: Sequence[float]) -> list[float]:
    low, high = min(values), max(values)
    return [(value - low) / (high - low) if high > low else 0.5 for value in values]


def _drawable(half_width: float) -> float:
    return half_width if math.isfinite(half_width) else 0.0


def _score_label(summary: Summary) -> str:
    return f"score ({summary.definition['score'][0]} of {summary.definition['criterion']})"


def _color(row: ConfigurationRow) -> str:
    return _COLORS.get(row.verdict, _OTHER)


def _short(row: ConfigurationRow) -> str:
    texts = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.configuration.values())
    pairs = [f"{_last(n)}={t}" for n, t in zip(row.configuration, texts, strict=True)]
    return f"#{row.number} " + (", ".join(pairs) if len(pairs) <= 2 else "")


def _last(name: str) -> str:
    return name.rpartition(".")[2]
