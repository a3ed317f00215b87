"""Behavior of people, models and agents in the same task: a table, a page, intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from scilab_rl.analysis.fitting.panel import Panel, make_panel
from scilab_rl.analysis.fitting.predictive import Behavior, Curve, task_behavior, task_curves
from scilab_rl.analysis.report import write_table
from scilab_rl.charts import Interval, Series
from scilab_rl.files import write_text
from scilab_rl.pages import render


@dataclass(frozen=True)
class BehaviorGroup:
    """Those who did the same task.

    Attributes:
        label: Name in tables.
        meaning: Who they are.
        panel: Their choices; of a single one who made several blocks, a row per block.
        unit: What intervals are computed over: participants, or blocks of a single one.
        shares: What they do.
        curves: How that changes.
    """

    label: str
    meaning: str
    panel: Panel
    unit: str
    shares: Behavior
    curves: tuple[Curve, ...]


def behavior_group(label: str, meaning: str, panel: Panel) -> BehaviorGroup:
    """Measure what is done in a table of choices.

    Args:
        label: Name in tables.
        meaning: Who they are.
        panel: Their choices.
    """
    unit = "participants"
    if len(panel.participants) == 1 and panel.seen.is_first.sum() > 1:
        unit = "blocks"
        panel = make_panel(
            [dict(row, participant_id=str(row.get("block"))) for row in panel.rows[0]]
        )
    curves = tuple(task_curves(panel))
    return BehaviorGroup(label, meaning, panel, unit, task_behavior(panel), curves)


def mean_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of shares and the ends of its 95 % interval (Student's t).

    Args:
        values: NaN where unknown; all NaN if nobody is known. A single one has no interval.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return np.nan, np.nan, np.nan
    mean = float(known.mean())
    if len(known) < 2:
        return mean, np.nan, np.nan
    error = float(stats.t.ppf(0.975, len(known) - 1) * known.std(ddof=1) / np.sqrt(len(known)))
    return mean, max(mean - error, 0.0), min(mean + error, 1.0)


def behavior_rows(groups: Sequence[BehaviorGroup]) -> list[dict[str, object]]:
    """Return all numbers: a row per group, behavior and place of a curve."""
    rows: list[dict[str, object]] = []
    for group in groups:
        measured = [(name, None, values) for name, values in group.shares.items()]
        for curve in group.curves:
            columns = zip(curve.places.tolist(), curve.shares.T, strict=True)
            measured += [(_name(curve), place, values) for place, values in columns]
        for name, place, values in measured:
            mean, low, high = (_known(number) for number in mean_interval(values))
            rows.append(
                {
                    "group": group.label,
                    "behavior": name,
                    "place": place,
                    "mean": mean,
                    "low": low,
                    "high": high,
                    "n": int(np.isfinite(values).sum()),
                    "unit": group.unit,
                }
            )
    return rows


def side_by_side(groups: Sequence[BehaviorGroup]) -> tuple[list[str], list[dict[str, object]]]:
    """Return columns and rows of a table with a column per group; curves in three places."""
    table: dict[str, dict[str, object]] = {}
    for row in behavior_rows(groups):
        name = str(row["behavior"])
        if row["place"] is not None:
            name += f" {row['place']:g}"
        table.setdefault(name, {"behavior": name})[str(row["group"])] = _text(row)
    hidden = {
        f"{_name(curve)} {place:g}"
        for curve in groups[0].curves
        for index, place in enumerate(curve.places)
        if index not in _shown(curve)
    }
    rows = [row for name, row in table.items() if name not in hidden]
    return ["behavior", *(group.label for group in groups)], rows


def _shown(curve: Curve) -> tuple[int, int, int]:
    """Return the places of a curve that a table has room for: around what happens in it."""
    last = len(curve.places) - 1
    if not curve.marks:
        return 0, last // 2, last
    after = int(np.searchsorted(curve.places, curve.marks[0][0]))
    return after - 1, after, last


def _name(curve: Curve) -> str:
    return f"{curve.y_label.removeprefix('share of ')}, {curve.x_label}"


def _text(row: Mapping[str, Any]) -> str:
    if row["mean"] is None:
        return "-"
    if row["low"] is None:
        return f"{row['mean']:.2f}"
    return f"{row['mean']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"


def _known(number: float) -> float | None:
    return number if np.isfinite(number) else None


def condition_rows(behaviors: Mapping[str, Behavior]) -> list[tuple[str, list[Interval]]]:
    """Return each condition with the rows of a forest plot, one for each group."""
    conditions = []
    for condition in next(iter(behaviors.values())):
        rows = []
        for color, (name, behavior) in enumerate(behaviors.items()):
            mean, low, high = mean_interval(behavior[condition])
            if np.isfinite(mean):
                ends = (low, high) if np.isfinite(low) else (mean, mean)
                rows.append(Interval(name, mean, *ends, color=color))
        conditions.append((condition, rows))
    return [(condition, rows) for condition, rows in conditions if rows]


def curve_charts(curves: Mapping[str, Sequence[Curve]]) -> list[tuple[Curve, list[Series]]]:
    """Return a chart per curve that several groups have: what it is, and a series per group."""
    charts: dict[str, tuple[Curve, list[Series]]] = {}
    for color, (name, own) in enumerate(curves.items()):
        for curve in own:
            ends = np.array([mean_interval(shares) for shares in curve.shares.T])
            known = np.isfinite(ends[:, 0])
            mean, low, high = np.where(np.isfinite(ends), ends, ends[:, :1])[known].T.tolist()
            places = curve.places[known].tolist()
            series = Series(name, mean=(places, mean), band=(places, low, high), color=color)
            charts.setdefault(curve.title, (curve, []))[1].append(series)
    return [chart for chart in charts.values() if len(chart[1]) > 1]


def write_behavior(groups: Sequence[BehaviorGroup], task: str, folder: Path) -> Path:
    """Write the page and the table into a folder; return the page."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(behavior_rows(groups), folder / "behavior.csv")
    write_text(folder / "behavior.html", behavior_page(groups, task))
    return folder / "behavior.html"


def behavior_page(groups: Sequence[BehaviorGroup], task: str) -> str:
    """Return one HTML file."""
    columns, rows = side_by_side(groups)
    about = [
        (group.label, f"{group.meaning}; {len(group.panel.participants)} {group.unit}")
        for group in groups
    ]
    return render(
        "behavior.html",
        title=f"{', '.join(columns[1:-1])} and {columns[-1]}",
        task=task,
        groups=about,
        choices=condition_rows({group.label: group.shares for group in groups}),
        curves=curve_charts({group.label: group.curves for group in groups}),
        numbers=(columns, [[row.get(name) for name in columns] for row in rows]),
    )
