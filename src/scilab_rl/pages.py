"""HTML pages from templates: each is one file that needs no server, no network and no other file.

The templates and the one stylesheet of all pages are in ``templates/``.
"""

from __future__ import annotations

import base64
import functools
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from scilab_rl import charts

if TYPE_CHECKING:
    from jinja2 import Environment

# Cells of tables that are drawn in color, see the stylesheet.
_STATES = (
    "pass", "better", "winner", "fail", "failed", "error", "worse", "inconclusive", "undecided",
)  # fmt: skip


class Link(NamedTuple):
    """A cell of a table that leads somewhere.

    Attributes:
        text: What is written.
        address: Where it leads, relative to the page.
    """

    text: str
    address: str


def render(template: str, **content: object) -> str:
    """Return a page; everything that goes into it is escaped.

    Args:
        template: Name of a file in ``templates/``.
        content: What the template shows.
    """
    return _environment().get_template(template).render(content)


def as_cell(value: object) -> str:
    """Return a value as the text of a table's cell.

    >>> as_cell(0.98765), as_cell(None), as_cell(12000)
    ('0.9877', '-', '12000')
    """
    if value is None:
        return "-"
    if isinstance(value, Link):
        return value.text
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def data_address(picture: bytes) -> str:
    """Return a picture as an address that holds it; an empty text where there is none."""
    if not picture:
        return ""
    return f"data:{media_type(picture)};base64,{base64.b64encode(picture).decode()}"


def media_type(picture: bytes) -> str:
    """Return the media type of a PNG or JPEG."""
    return "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters |= {"as_cell": as_cell, "data_address": data_address}
    environment.globals |= {"STATES": _STATES, "charts": charts}
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    return environment
