"""``scilab-rl plot RUN ...``: learning curves in the terminal, as PNG and as SVG."""

from __future__ import annotations

import argparse
import functools
import logging
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import is_terminal, write
from scilab_rl.drawing import COLORS, number_text
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.run.curves import Chart, Curve, in_characters, series, write_png, write_svg

if TYPE_CHECKING:  # heavy
    from scilab_rl.analysis.groups import Group

_log = logging.getLogger(__name__)
_DEFAULT = ("eval/success_rate", "eval/mean_reward")
_ROWS = 12
_WRITERS = {".png": write_png, ".svg": write_svg}


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    from scilab_rl.analysis.groups import find_group, read_records

    if options.output is not None and options.output.suffix.lower() not in _WRITERS:
        raise ConfigError(f"--output must end in .png or .svg, but it is '{options.output}'.")
    base = options.base_logdir
    records = functools.cache(lambda: read_records(base))
    groups = [find_group(word, records, base) for word in options.runs]
    charts = [chart_of(groups, metric) for metric in _metrics(groups, options.metric)]
    for chart in charts:
        _print_chart(chart)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        _WRITERS[options.output.suffix.lower()](charts, options.output)
        _log.info("%s", options.output)
    return 0


def chart_of(groups: Sequence[Group], metric: str) -> Chart:
    """Return the curves of all runs, thin where a group has several, and then also their mean."""
    curves: list[Curve] = []
    for color, group in enumerate(groups):
        runs = [series(_rows(run.path), metric) for run in group.runs]
        runs = [(steps, values) for steps, values in runs if steps]
        label = group.label if len(groups) > 1 else ""
        if len(runs) > 1:
            curves += [Curve(steps, values, color, is_faint=True) for steps, values in runs]
            curves.append(Curve(*_mean(runs), color, f"{group.label} ({len(runs)} runs)"))
        else:
            curves += [Curve(steps, values, color, label) for steps, values in runs]
    return Chart(metric, curves)


def _mean(
    runs: Sequence[tuple[list[float], list[float]]],
) -> tuple[list[float], list[float]]:
    """Return the mean over runs wherever all of them have a value.

    Between two evaluations, a run has the value of the earlier one.
    """
    import numpy as np

    first, last = max(steps[0] for steps, _ in runs), min(steps[-1] for steps, _ in runs)
    every = sorted({step for steps, _ in runs for step in steps if first <= step <= last})
    places = [np.searchsorted(steps, every, side="right") - 1 for steps, _ in runs]
    values = [np.asarray(values)[at] for (_, values), at in zip(runs, places, strict=True)]
    return every, list(np.mean(values, axis=0)) if every else []


@functools.cache
def _rows(path: Path) -> list[dict[str, float]]:
    from scilab_rl.run.directory import RunDirectory, read_epochs

    return read_epochs(RunDirectory(path))


def _metrics(groups: Sequence[Group], wanted: Sequence[str]) -> list[str]:
    """Return the metrics to show.

    Raises:
        ConfigError: If none of the runs has one of them.
    """
    rows = [row for group in groups for run in group.runs for row in _rows(run.path)]
    known = sorted({name for row in rows for name in row if "/" in name})
    if not known:
        raise ConfigError("These runs have not been evaluated yet: they need one epoch.")
    chosen = [
        name if name in known or "/" in name else f"eval/{name}"
        for name in wanted or [name for name in _DEFAULT if name in known][:1]
    ]
    for name in chosen:
        if name not in known:
            raise ConfigError(
                f"No run has the metric '{name}'.{did_you_mean(name, known)} There are "
                f"{listing(known, limit=40)}."
            )
    return chosen


def _print_chart(chart: Chart) -> None:
    from rich.console import Console
    from rich.text import Text

    dots = (sys.stdout.encoding or "").lower().startswith("utf")
    width = min(shutil.get_terminal_size().columns - 10, 100)
    rows = in_characters(chart, max(width, 20), _ROWS, dots=dots and is_terminal())
    console = Console(highlight=False, soft_wrap=True)
    write(chart.title)
    for number, cells in enumerate(rows):
        value = {0: chart.high, _ROWS - 1: chart.low}.get(number)
        text = Text(f"{'' if value is None else number_text(value):>8} |")
        for character, color in cells:
            text.append(character, COLORS[color % len(COLORS)] if color >= 0 else "")
        text.rstrip()
        console.print(text)
    end = f"{chart.end:,.0f} steps"
    write(f"{'':>9}+{'-' * len(rows[0])}\n{'':>10}0{end:>{len(rows[0]) - 1}}")
    for curve in chart.curves:
        if curve.label:
            mark, color = in_characters(Chart("", [curve]), 1, 1, dots=False)[0][0]
            sign = Text("—" if dots and is_terminal() else mark, COLORS[color % len(COLORS)])
            console.print(Text.assemble("  ", sign, f" {curve.label}"))
    sys.stdout.flush()


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser("plot", "Draw the learning curves of runs.", base=True)
    add = parser.add_argument
    add(
        "runs", nargs="+", metavar="RUN",
        help="runs as everywhere, or groups of them as in compare: a study, algorithm, tag, "
        "pattern; LABEL=RUN names it",
    )  # fmt: skip
    add("--metric", action="append", default=[], metavar="NAME",
        help="any metric, may be repeated; default: success, else mean reward")  # fmt: skip
    add("--output", type=Path, metavar="FILE", help="also write a picture: .png or .svg")
    return parser.parse_args(arguments)
