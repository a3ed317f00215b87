"""Lists on standard output: a drawn table on a terminal, tab-separated lines elsewhere, or JSON."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence

Row = Mapping[str, object]

# Longer cells are folded into several lines before a column is dropped.
_FOLD_WIDTH, _PROSE_WIDTH = 18, 12
_GAP = 2
_STYLES = {
    "ok": "green",
    "finished": "green",
    "solved": "green",
    "running": "cyan",
    "warn": "yellow",
    "interrupted": "yellow",
    "pruned": "yellow",
    "fail": "red",
    "failed": "red",
    "damaged": "red",
    "crashed": "red",
}


def print_rows(
    columns: Sequence[str],
    rows: Sequence[Row],
    *,
    optional: Sequence[str] = (),
    if_any: Sequence[str] = (),
    prose: Sequence[str] = (),
    as_json: bool = False,
) -> None:
    """Print one line per row.

    A terminal gets a table. If it is too narrow, the optional columns are dropped; if that is not
    enough (20 columns), each row becomes a block of ``name: value`` lines. Pipes and files get a
    heading and tab-separated lines.

    Args:
        columns: The names to show, which are keys of the rows.
        rows: The rows; a missing value and None are shown as ``-``.
        optional: Columns that a narrow terminal may drop, the least important first.
        if_any: Columns that are dropped if no row has a value.
        prose: Columns that stay readable in 12 columns of the terminal.
        as_json: Whether to print the rows as JSON instead, with all their keys.
    """
    if as_json:
        print_json(rows)
        return
    columns = [c for c in columns if c not in if_any or any(row.get(c) for row in rows)]
    cells = [{name: _cell(row.get(name)) for name in columns} for row in rows]
    if is_terminal():
        _draw(columns, cells, optional, prose)
    else:
        write("\t".join(columns))
        for row in cells:
            write("\t".join(row.values()))
    # A closed pipe must be noticed here, not when the interpreter ends.
    sys.stdout.flush()


def print_json(value: object) -> None:
    """Print a value as JSON."""
    write(json.dumps(value, indent=2))
    sys.stdout.flush()


def as_typed(value: object) -> str:
    """Return a value as the user would type it on the command line.

    >>> as_typed(None), as_typed(True), as_typed("")
    ('null', 'true', "''")
    """
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    return "''" if value == "" else str(value)


def write(line: str) -> None:
    """Write a line to standard output; what its encoding does not have becomes ``?``."""
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(line.encode(encoding, "replace").decode(encoding) + "\n")


def is_terminal() -> bool:
    """Return whether standard output is a terminal that can show a table."""
    plain = os.environ.get("TERM") == "dumb" or "CI" in os.environ
    return sys.stdout.isatty() and not plain


def _cell(value: object) -> str:
    """Return a value as text without tabs and line ends."""
    if value is None or value == "":
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_cell, value)) or "-"
    return " ".join(str(value).split())


def _draw(
    columns: Sequence[str],
    cells: Sequence[Mapping[str, str]],
    optional: Sequence[str],
    prose: Sequence[str],
) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    shown = _fitting(columns, cells, optional, prose, console.width)
    if shown is None:
        for row in cells:
            write("\n".join(f"{name}: {text}" for name, text in row.items()) + "\n")
        return
    table = Table(box=None, padding=(0, _GAP, 0, 0), pad_edge=False, header_style="bold")
    for name in shown:
        table.add_column(name, overflow="fold")
    encoding = sys.stdout.encoding or "utf-8"
    for row in cells:
        texts = [row[name].encode(encoding, "replace").decode(encoding) for name in shown]
        table.add_row(*(Text(text, style=_STYLES.get(text, "")) for text in texts))
    console.print(table)


def _fitting(
    columns: Sequence[str],
    cells: Sequence[Mapping[str, str]],
    optional: Sequence[str],
    prose: Sequence[str],
    width: int,
) -> list[str] | None:
    """Return the columns that fit, or None if even the required ones do not."""
    needed = {
        name: min(
            _PROSE_WIDTH if name in prose else _FOLD_WIDTH,
            max(len(name), *(len(row[name]) for row in cells), 1),
        )
        for name in columns
    }
    shown = list(columns)
    for name in (None, *optional):
        if name in shown:
            shown.remove(name)
        if sum(needed[name] + _GAP for name in shown) - _GAP <= width:
            return shown
    return None
