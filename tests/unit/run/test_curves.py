"""Learning curves as pictures and in characters."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from scilab_rl.cli import plot
from scilab_rl.drawing import COLORS
from scilab_rl.errors import ConfigError
from scilab_rl.run.curves import (
    HEIGHT,
    WIDTH,
    Chart,
    Curve,
    in_characters,
    series,
    write_png,
    write_run_curve,
    write_svg,
)

ROWS = [
    {"step": 100, "eval/success_rate": 0.0, "eval/mean_reward": -5.0},
    {"step": 200, "eval/mean_reward": float("nan")},
    {"step": 300, "eval/success_rate": 1.0, "eval/mean_reward": -1.0},
]


def test_gaps_are_left_out():
    assert series(ROWS, "eval/success_rate") == ([100.0, 300.0], [0.0, 1.0])
    assert series(ROWS, "eval/mean_reward") == ([100.0, 300.0], [-5.0, -1.0])
    assert series(ROWS, "other") == ([], [])


def test_success_is_shown_from_0_to_1_and_a_flat_curve_in_the_middle():
    success = Chart("eval/success_rate", [Curve([1, 2], [0.2, 0.4])])
    assert (success.low, success.high) == (0.0, 1.0)
    flat = Chart("eval/mean_reward", [Curve([1, 2], [-4.0, -4.0])])
    assert (flat.low, flat.high, flat.end) == (-6.0, -2.0, 2)
    assert flat.points(flat.curves[0], 0, 0, 10, 8) == [(5.0, 4.0), (10.0, 4.0)]


def test_a_run_has_a_panel_for_success_and_one_for_reward(tmp_path):
    write_run_curve(ROWS, tmp_path / "curve.png")
    with Image.open(tmp_path / "curve.png") as picture:
        assert picture.size == (2 * WIDTH, HEIGHT)
    write_run_curve(ROWS[:1], tmp_path / "short.png")
    assert [path.name for path in tmp_path.iterdir()] == ["curve.png"]


def test_a_curve_is_where_its_values_are(tmp_path):
    write_png([Chart("x", [Curve([0, 100], [0.0, 1.0])])], tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as picture:
        image = np.asarray(picture).astype(int)
    blue = [int(COLORS[0][i : i + 2], 16) for i in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(image - blue).sum(axis=-1) < 40)
    slope = np.polyfit(columns, rows, 1)[0]
    assert slope == pytest.approx(-(HEIGHT - 44 - 38) / (WIDTH - 64 - 32), rel=0.02)


def test_an_svg_is_xml_with_one_line_per_curve(tmp_path):
    curves = [Curve([0, 1], [0.0, 1.0], 0, "a < b"), Curve([0, 1], [1.0, 0.0], 1, "c")]
    write_svg([Chart("eval/x", curves)], tmp_path / "a.svg")
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    lines = [element for element in root if element.tag.endswith("polyline")]
    texts = {element.text for element in root if element.tag.endswith("text")}
    assert sum(line.get("stroke") in COLORS[:2] for line in lines) == 4  # with the legend
    assert {"a < b", "c", "eval/x"} <= texts


def test_characters():
    chart = Chart("eval/success_rate", [Curve([0, 1], [0.0, 1.0]), Curve([0, 1], [1.0, 1.0], 1)])
    rows = in_characters(chart, 4, 4, dots=False)
    assert ["".join(letter for letter, _ in row) for row in rows] == [
        "++++",
        "  * ",
        " *  ",
        "*   ",
    ]
    assert rows[0][0] == ("+", 1)
    dots = in_characters(Chart("eval/success_rate", [Curve([0, 1], [0.0, 1.0])]), 1, 1, dots=True)
    assert dots == [[(chr(0x2800 | 0x40 | 0x04 | 0x10 | 0x08), 0)]]  # two dots left, two right


@pytest.fixture
def trained(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = {
        "env": "E-v0", "algorithm": {"name": "sac"}, "n_epochs": 2, "eval_after_n_steps": 10,
    }  # fmt: skip
    for index in range(2):
        run = tmp_path / "data" / "2026-01-02" / f"10000{index}-E-sac-s{index}-00a{index}"
        run.mkdir(parents=True)
        (run / "config.yaml").write_text(json.dumps({**config, "seed": index}))
        rows = [
            {"kind": "epoch", "epoch": e, "step": 10 * e, "eval/success_rate": e * (index + 1) / 4}
            for e in (1, 2)
        ]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_plot_shows_runs_and_groups(trained, capsys):
    assert plot.main(["00a0", "all=sac", "--output", "out/x.svg"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("eval/success_rate\n")
    assert {"* 00a0", "+ all (2 runs)"} <= {line.strip() for line in said.splitlines()}
    assert "polyline" in (plot.Path("out") / "x.svg").read_text()


def test_the_mean_of_a_group(trained):
    from scilab_rl.analysis.groups import find_group, read_records

    base = plot.Path("data")
    chart = plot.chart_of(
        [find_group("sac", lambda: read_records(base), base)], "eval/success_rate"
    )
    assert [curve.values for curve in chart.curves] == [[0.25, 0.5], [0.5, 1.0], [0.375, 0.75]]


def test_an_unknown_metric_or_picture_is_refused(trained):
    with pytest.raises(ConfigError, match="Did you mean 'eval/success_rate'"):
        plot.main(["00a0", "--metric", "succes_rate"])
    with pytest.raises(ConfigError, match=r"\.png or \.svg"):
        plot.main(["00a0", "--output", "x.gif"])
