"""The futures of an episode as one offline page, a picture, and tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.analysis.whatif import Decision, Future, SceneRate
from scilab_rl.analysis.whatif_scenes import ScenePictures
from scilab_rl.charts import Series, axis
from scilab_rl.drawing import COLORS, FAINT, INK
from scilab_rl.files import atomic_write, write_text
from scilab_rl.pages import render
from scilab_rl.recording.records import Clip, decode_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUCCEEDS, FAILS = COLORS[0], COLORS[1]  # blue and orange, which are safe for color-blind readers
_PANELS = (("distances", "goal distance"), ("values", "value"), ("rewards", "reward"))


@dataclass(frozen=True)
class Report:
    """All that is shown.

    Attributes:
        clip: The recorded episode.
        facts: Names and values for the top of the page.
        question: What was changed, as a sentence.
        happened: The episode.
        likely: The future of the most likely actions, by scene.
        futures: Those with noise.
        decision: When the episode was decided, if that was asked.
        scene_pictures: Pictures of the scenes.
        goal: Another desired goal than the episode's.
    """

    clip: Clip
    facts: Sequence[tuple[str, object]]
    question: str
    happened: Future
    likely: Mapping[int, Future]
    futures: Sequence[Future]
    decision: Decision | None = None
    scene_pictures: ScenePictures = field(default_factory=lambda: ScenePictures({}))
    goal: np.ndarray | None = None

    @property
    def scenes(self) -> list[int]:
        """The scenes whose futures were played."""
        return sorted({future.scene for future in self.futures})

    def of_scene(self, scene: int) -> list[Future]:
        """Return the futures of a scene."""
        return [future for future in self.futures if future.scene == scene]


def verdict(report: Report) -> str:
    """Return what was found, in a few sentences."""
    if report.decision is None:
        futures = report.futures
        if all(future.success is None for future in futures):
            returns = [sum(future.rewards) for future in futures]
            return (
                f"{len(futures)} futures of scene {report.scenes[0]}: mean return "
                f"{np.mean(returns):.4g} (from {min(returns):.4g} to {max(returns):.4g})."
            )
        n = sum(bool(future.success) for future in futures)
        rate = SceneRate(report.scenes[0], n, len(futures))
        return f"From scene {rate.scene}, {_rate_text(rate)} futures succeed."
    return _decision_text(report.decision, len(report.clip.records) - 1)


def _decision_text(found: Decision, n_steps: int) -> str:
    outcome, what = (
        ("succeeded", "point from which success was certain")
        if found.succeeded
        else ("failed", "point of no return")
    )
    before = [rate for rate in found.rates if rate.scene < found.scene]
    n = found.rates[0].n
    if found.scene == n_steps:
        text = f"The episode {outcome}, and it was open until its last step."
    elif not before:
        text = f"The episode {outcome}, and so did all {n} futures of every scene."
    else:
        text = (
            f"The episode {outcome}. The {what} is scene {found.scene}: from there on, "
            f"{'all' if found.succeeded else 'none'} of {n} futures succeed; one scene earlier, "
            f"{_rate_text(before[-1])}."
        )
    if found.largest_change is not None:
        first, second = found.largest_change
        if first.n_successes != second.n_successes:
            text += (
                f" The largest change: {first.n_successes} of {first.n} in scene {first.scene}, "
                f"{second.n_successes} of {second.n} in scene {second.scene}."
            )
    return text


def _rate_text(rate: SceneRate) -> str:
    found = rate.estimate
    return f"{rate.n_successes} of {rate.n} (95 % interval {found.low:.2f} to {found.high:.2f})"


def write_page(report: Report, path: Path) -> None:
    """Write the page; CSV files and picture are expected next to it, with the same name."""
    pictures = report.scene_pictures.pictures
    data = {
        "scenes": report.scenes,
        "futures": {scene: _drawn(report, report.of_scene(scene)) for scene in report.scenes},
        "likely": {scene: _drawn(report, [f]) for scene, f in report.likely.items()},
        "happened": _drawn(report, [report.happened])[0],
        "goal": report.scene_pictures.pixels(report.goal),
        "last": len(report.clip.records) - 1,
        "start": _first_shown(report),
    }
    content = {
        "title": f"{report.clip.info.env_id}: {report.question}",
        "facts": [*report.facts],
        "verdict": verdict(report),
        "panels": _panels(report),
        "pictures": pictures,
        "has_pictures": any(pictures.values()),
        "has_fan": report.scene_pictures.view is not None,
        "rates": report.decision and [(r, r.estimate) for r in report.decision.rates],
        "decision": report.decision,
        "series": report.decision and [_rate_series(report.decision)],
        "data": data,
        "name": path.stem,
    }
    write_text(path, render("whatif.html", **content))


def _first_shown(report: Report) -> int:
    """Return the index of the scene that is shown first: the last one that was open."""
    if report.decision is None:
        return 0
    before = [i for i, scene in enumerate(report.scenes) if scene < report.decision.scene]
    return before[-1] if before else 0


def _rate_series(found: Decision) -> Series:
    scenes = [rate.scene for rate in found.rates]
    estimates = [rate.estimate for rate in found.rates]
    band = scenes, [e.low for e in estimates], [e.high for e in estimates]
    return Series("futures that succeed", mean=(scenes, [e.value for e in estimates]), band=band)


def _panels(report: Report) -> list[dict[str, object]]:
    """Return the axes of the curves, which hold all futures, so that nothing jumps."""
    together = [report.happened, *report.likely.values(), *report.futures]
    x = axis((), (0, max(f.scene + len(f.rewards) for f in together)))
    panels = []
    for name, label in _PANELS:
        numbers = [number for future in together for number in getattr(future, name)]
        if numbers:
            panels.append({"name": name, "label": label, "x": x, "y": axis(numbers)})
    return panels


def _drawn(report: Report, futures: Sequence[Future]) -> list[dict[str, object]]:
    return [
        {
            "success": future.success,
            "scene": future.scene,
            "path": [report.scene_pictures.pixels(place) for place in future.achieved],
            **{name: [_short(number) for number in getattr(future, name)] for name, _ in _PANELS},
        }
        for future in futures
    ]


def _short(number: float) -> float:
    return float(f"{number:.4g}")


def write_tables(report: Report, path: Path) -> None:
    """Write one row per future, and, where it was asked, one per scene to ``NAME_scenes.csv``."""
    rows = [
        {
            "scene": future.scene,
            "success": "" if future.success is None else int(future.success),
            "steps": len(future.rewards),
            "return": sum(future.rewards),
            "final_distance": future.distances[-1] if future.distances else "",
        }
        for future in report.futures
    ]
    _write_csv(path, rows)
    if report.decision is not None:
        rates = [
            {
                "scene": r.scene,
                "successes": r.n_successes,
                "futures": r.n,
                "rate": r.estimate.value,
                "low": r.estimate.low,
                "high": r.estimate.high,
            }
            for r in report.decision.rates
        ]
        _write_csv(path.with_name(f"{path.stem}_scenes.csv"), rates)


def _write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def draw(report: Report, path: Path) -> None:
    """Draw scenes with their futures, and the curve of decisions or of goal distances, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [s for s in _shown_scenes(report) if report.scene_pictures.pictures.get(s)]
    panels = [] if report.decision else _known_panels(report)
    figure = Figure(figsize=(9.6, 5.9 if shown else 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    n_columns = max(len(panels), 1) * max(len(shown), 1)
    grid = figure.add_gridspec(
        2 if shown else 1, n_columns, height_ratios=(1.4, 1) if shown else (1,)
    )
    for index, scene in enumerate(shown):
        width = n_columns // len(shown)
        axes = figure.add_subplot(grid[0, index * width : (index + 1) * width])
        _draw_scene(report, scene, axes)
    if report.decision is not None:
        _draw_decision(report.decision, figure.add_subplot(grid[-1, :]))
    for index, (name, label) in enumerate(panels):
        width = n_columns // len(panels)
        axes = figure.add_subplot(grid[-1, index * width : (index + 1) * width])
        _draw_curves(report, name, label, axes)
    atomic_write(path, lambda file: figure.savefig(file, dpi=130, format="png"))


def _shown_scenes(report: Report) -> list[int]:
    """Return at most three scenes: the first, the last open one and the decided one."""
    if report.decision is None:
        return report.scenes
    last_open = report.scenes[_first_shown(report)]
    decided = [scene for scene in report.scenes if scene >= report.decision.scene][:1]
    return sorted({report.scenes[0], last_open, *decided})


def _known_panels(report: Report) -> list[tuple[str, str]]:
    return [(name, label) for name, label in _PANELS if getattr(report.futures[0], name)]


def _draw_scene(report: Report, scene: int, axes: Axes) -> None:
    picture = report.scene_pictures.pictures.get(scene)
    axes.set_axis_off()
    futures = report.of_scene(scene)
    known = [future for future in futures if future.success is not None]
    n = sum(bool(future.success) for future in known)
    axes.set_title(
        f"scene {scene}" + (f": {n} of {len(known)} succeed" if known else ""), fontsize=10
    )
    if not picture:
        return
    pixels = decode_picture(picture)
    axes.imshow(pixels)
    height, width = pixels.shape[:2]
    for future in futures:
        color = FAILS if future.success is False else SUCCEEDS
        _draw_path(report, future, axes, (width, height), color=color, linewidth=1.0, alpha=0.75)
    for color, line in (("white", 3.4), (INK, 1.6)):
        style = {"color": color, "linewidth": line}
        _draw_path(report, report.happened, axes, (width, height), first=scene, **style)
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)


def _draw_path(
    report: Report,
    future: Future,
    axes: Axes,
    size: tuple[int, int],
    first: int = 0,
    **style: object,
) -> None:
    seen = [report.scene_pictures.pixels(place) for place in future.achieved[first:]]
    for number in range(len(seen[0]) if seen else 0):
        places = np.array([place[number] for place in seen]) * size
        axes.plot(*places.T, solid_capstyle="round", **style)  # type: ignore[arg-type]


def _draw_decision(found: Decision, axes: Axes) -> None:
    scenes = [rate.scene for rate in found.rates]
    estimates = [rate.estimate for rate in found.rates]
    low, high = [e.low for e in estimates], [e.high for e in estimates]
    axes.fill_between(scenes, low, high, color=SUCCEEDS, alpha=0.15, linewidth=0)
    axes.plot(scenes, [e.value for e in estimates], color=SUCCEEDS, marker="o", markersize=3)
    axes.axvline(found.scene, color=INK, linestyle="--", linewidth=1)
    text = "certain from here" if found.succeeded else "point of no return"
    axes.annotate(f"{text}: scene {found.scene}", (found.scene, 1.04), fontsize=9, ha="center",
                  va="bottom", annotation_clip=False)  # fmt: skip
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("scene (step of the episode)")
    axes.set_ylabel(f"share of {found.rates[0].n} futures\nthat succeed, 95 % interval")
    axes.spines[["top", "right"]].set_visible(False)


def _draw_curves(report: Report, name: str, label: str, axes: Axes) -> None:
    for future in report.futures:
        values = getattr(future, name)
        color = FAILS if future.success is False else SUCCEEDS
        axes.plot(
            future.scene + np.arange(len(values)), values, color=color, linewidth=0.8, alpha=0.6
        )
    happened = getattr(report.happened, name)
    axes.plot(np.arange(len(happened)), happened, color=INK, linewidth=1.8)
    axes.axvline(report.scenes[0], color=FAINT, linestyle="--", linewidth=1)
    axes.set_xlabel("step")
    axes.set_title(label, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
