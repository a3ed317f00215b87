"""The report of a study as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping
from pathlib import Path

from scilab_rl.hyperopt.runs import FAILED
from scilab_rl.hyperopt.summary import Summary

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; background: #fff; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { text-align: left; padding: .25rem .75rem; border-bottom: 1px solid #ddd;
         vertical-align: top; font-variant-numeric: tabular-nums; }
tr.winner td { background: #fdf0e6; font-weight: 600; }
figure { margin: 2rem 0; } img { max-width: 100%; } figcaption { color: #555; }
code { background: #f4f4f4; padding: .1rem .3rem; }
"""


def render(summary: Summary, figures: Mapping[str, Path]) -> str:
    """Return the page.

    Args:
        summary: What the study has found.
        figures: Caption to PNG file; the images go into the page.
    """
    parts = [
        f"<h1>{_escape(summary.name)}</h1>",
        _table(("", ""), summary.facts(), heading=False),
        _explanation(summary),
        *(_figure(caption, path) for caption, path in figures.items()),
        "<h2>All settings</h2>",
        _settings(summary),
        _failures(summary),
        "<h2>Train with the winner</h2>",
        f"<p><code>python src/main.py +best_of={_escape(summary.name)}</code></p>",
    ]
    title = _escape(summary.name)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _explanation(summary: Summary) -> str:
    scores = ", ".join(summary.definition["score"])
    return (
        f"<p>Score: <b>{_escape(scores)}</b> of <b>{_escape(summary.definition['criterion'])}</b>. "
        "Each setting is a mean over runs with different seeds, the same seeds for all settings; "
        "± is half of a 90 % confidence interval. The winner was chosen by the pessimistic end of "
        "its interval. Being chosen flatters: the score with <i>new</i> seeds, which the search "
        "never saw, is the one to believe.</p>"
    )


def _settings(summary: Summary) -> str:
    names = list(summary.definition["space"])
    rows = [
        [f"#{row.number}", *(_value(row.setting.get(name)) for name in names), str(row.n_runs)]
        + ([row.interval] if not summary.front else [", ".join(f"{v:.4g}" for v in row.values)])
        + [row.verdict]
        for row in summary.rows
    ]
    return _table(("", *names, "runs", "score", ""), rows)


def _failures(summary: Summary) -> str:
    rows = [
        (f"run {run.number}", f"#{run.trial}", run.error, run.run_dir)
        for run in summary.runs
        if run.state == FAILED
    ]
    if not rows:
        return ""
    return "<h2>Failed runs</h2>" + _table(("", "setting", "error", "folder"), rows)


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]], *, heading: bool = True) -> str:
    head = "".join(f"<th>{_escape(name)}</th>" for name in columns) if heading else ""
    body = ""
    for row in rows:
        cells = list(row)
        chosen = ' class="winner"' if cells[-1] == "winner" else ""
        body += f"<tr{chosen}>" + "".join(f"<td>{_escape(cell)}</td>" for cell in cells) + "</tr>"
    return f"<table>{f'<tr>{head}</tr>' if head else ''}{body}</table>"


def _figure(caption: str, path: Path) -> str:
    image = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><img alt="{_escape(caption)}" src="data:image/png;base64,{image}">'
        f"<figcaption>{_escape(caption)}</figcaption></figure>"
    )


def _value(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)


def _escape(text: str) -> str:
    return html.escape(str(text))
