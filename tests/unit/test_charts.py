"""Charts of pages: numbers lie where they belong, and what was not measured is not drawn."""

from __future__ import annotations

import math
import re

import pytest

from scilab_rl import charts, pages
from scilab_rl.charts import Axis, Interval, Series

X, Y = Axis(0, 100), Axis(0, 1)


def drawn(macro: str, **content: object) -> str:
    """Return what a macro draws."""
    call = "{% import 'macros.html' as m %}{{ m." + macro + " }}"
    return pages._environment().from_string(call).render(content)


def test_a_curve_has_a_gap_where_nothing_was_measured() -> None:
    assert charts.path([0, 25, 50, 100], [0.0, 0.5, None, 1.0], X, Y) == (
        "M0.0 100.0L25.0 50.0M100.0 0.0"
    )
    assert charts.path([0, 100], [math.nan, 0.25], X, Y) == "M100.0 75.0"


def test_marks_are_only_at_measured_values() -> None:
    assert charts.dots([0, 50, 100], [1.0, None, 0.0], X, Y) == "M0.0 0.0h.01M100.0 100.0h.01"


def test_a_band_goes_there_and_back() -> None:
    assert charts.area([0, 100], [0.0, 0.5], [0.5, 1.0], X, Y) == (
        "M0.0 50.0L100.0 0.0L100.0 50.0L0.0 100.0Z"
    )


@pytest.mark.parametrize(
    ("numbers", "options", "expected"),
    [
        ([], {}, (0, 1)),
        ([2.0, None, 4.0], {"tight": True}, (2, 4)),
        ([0.2], {"wanted": (0, 1)}, (0, 1)),
        ([0.0, 1.0], {}, (-0.05, 1.05)),
        ([-1.0, 1.0, 100.0], {"log": True, "tight": True}, (100**-0.05, 100**1.05)),
    ],
)
def test_axes_hold_their_numbers(
    numbers: list[float | None], options: dict[str, object], expected: tuple[float, float]
) -> None:
    found = charts.axis(numbers, **options)  # type: ignore[arg-type]
    assert (found.low, found.high) == pytest.approx(expected)


def test_an_axis_of_equal_numbers_is_not_empty() -> None:
    for number in (0.0, -3.0):
        found = charts.axis([number, number])
        assert found.low < number < found.high


def test_ticks_of_ratios_are_powers_of_ten() -> None:
    assert Axis(1, 100, log=True).ticks() == [(0.0, "1"), (50.0, "10"), (100.0, "100")]


def test_colors_of_a_heat_map_go_from_its_first_to_its_last() -> None:
    assert charts.heat_color(0.5) == "#21918c"
    assert charts.heat_color(2.0) == charts.heat_color(1.0) == "#fde725"
    assert charts.heat_color(math.nan) == charts.heat_color(None)


def test_every_chart_escapes_its_texts_and_draws_its_numbers() -> None:
    evil = "<b>"
    curve = Series(evil, lines=[([0, 1], [0.0, 1.0])], mean=([0, 1], [0.0, 1.0]))
    row = Interval(evil, 0.5, 0.25, 0.75, points=(0.5,), at=0.5, n=3)
    content = {"series": [curve, curve], "rows": [row], "evil": evil}
    for macro, expected in {
        "line_chart(series, evil, evil, y_range=(0, 1))": "M0.0 100.0L100.0 0.0",
        "forest_plot(rows, evil, x_range=(0, 1))": "M25.0 42H75.0",
        "reliability_curve(rows, evil, evil)": "M50.0 75.0V25.0",
        "heat_map([[0, none], [0.5, 1]], (0, 1), (0, 1), evil, evil, evil)": 'fill="#21918c"',
        "bars([(evil, 0.25)])": "width:25.0%",
    }.items():
        text = drawn(macro, **content)
        assert expected in text
        assert evil not in re.sub("<b>[-.0-9k]*</b>", "", text)
        assert "&lt;b&gt;" in text


def test_a_cell_that_is_a_link_leads_to_its_address() -> None:
    text = drawn("table(['run'], [[link]])", link=pages.Link("seed 1", "../runs/1"))
    assert '<td><a href="../runs/1">seed 1</a></td>' in text
