"""The goal microscope of a run or an agent: its page, pictures, tables and recorded episodes."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl import files
from scilab_rl.analysis.calibration import Calibration
from scilab_rl.analysis.goals import BUFFER_SIZE, N_ENVS, GoalSettings, GoalStudy, study_goals
from scilab_rl.analysis.report import write_table
from scilab_rl.charts import Interval, Series
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import RunConfig
from scilab_rl.pages import Link, render
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory
from scilab_rl.run.player import load_player

if TYPE_CHECKING:  # heavy
    import gymnasium as gym
    from matplotlib.axes import Axes
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.analysis.goal_values import ValueMap
    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.learning.replayed_goals import ReplayedGoals

FOLDER = "goals"
_N_BINS = 20
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PolicyValues:
    """The value maps of one saved policy.

    Attributes:
        name: For example ``finished, step 100,000``.
        maps: One for each slice.
        scenes: The start state's scene with each map painted into it, where there is one.
    """

    name: str
    maps: Sequence[ValueMap]
    scenes: Sequence[np.ndarray | None]


@dataclass(frozen=True)
class GoalReport:
    """What was written.

    Attributes:
        study: What was found.
        values: Value maps of each policy, in the order of training; none without values.
        folder: Where the files are; ``goals.html`` is the page.
    """

    study: GoalStudy
    values: Sequence[PolicyValues]
    folder: Path

    @property
    def page(self) -> Path:
        """The page."""
        return self.folder / "goals.html"


def examine(
    run: RunDirectory,
    policy: Path,
    settings: GoalSettings,
    *,
    checkpoints: Sequence[Path] = (),
    n_recorded: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> GoalReport:
    """Examine the goals of a run's policy and write what was found into the folder ``goals``.

    Args:
        run: A run or a trained agent.
        policy: The policy that plays.
        settings: How closely to look.
        checkpoints: Policies whose values are shown too, for a slider.
        n_recorded: How many failed episodes are recorded.
        progress: Called after each episode: how many are done, and of how many.

    Raises:
        ConfigError: If the environment has no goals, or they cannot be chosen.
    """
    cfg = load_recorded(run / CONFIG_FILE)
    training = kept_goals(run, cfg, policy)
    env, model = load_player(cfg, policy, record=False, n_envs=N_ENVS, buffer_size=BUFFER_SIZE)
    try:
        study = study_goals(model, env, settings, cfg.env, progress=progress, training=training)
    finally:
        env.close()
    env, model = load_player(cfg, policy, record=True)
    try:
        values = _values_of(model, env, study, policy, checkpoints)
        links = _record(model, env, cfg, run, study, _policy_name(policy), n_recorded)
    finally:
        env.close()
    report = GoalReport(study, values, run.outputs / FOLDER)
    _write(report, f"{cfg.env}, {run if run.is_agent else run.path.name}", policy, links)
    return report


def kept_goals(run: RunDirectory, cfg: RunConfig, policy: Path) -> ReplayedGoals | None:
    """Return goals of the replay buffer in a run's newest checkpoint, if it has hindsight."""
    from stable_baselines3 import HerReplayBuffer

    from scilab_rl.learning.replayed_goals import replayed_goals
    from scilab_rl.training import checkpoint
    from scilab_rl.training.resume import newest_checkpoint
    from scilab_rl.training.snapshot import restore

    directory = newest_checkpoint(run.path)
    if directory is None:
        return None
    size = int(cfg.algorithm.arguments.get("buffer_size", 0))
    env, model = load_player(cfg, policy, record=False, n_envs=cfg.n_envs, buffer_size=size)
    try:
        restore({"algorithm": model}, checkpoint.load(directory))
        buffer = getattr(model, "replay_buffer", None)
        if not isinstance(buffer, HerReplayBuffer):
            return None
        origin = f"the replay buffer of the training, in the checkpoint {directory.name}"
        return replayed_goals(buffer, origin)
    finally:
        env.close()


def _values_of(
    model: Algorithm, env: VecEnv, study: GoalStudy, policy: Path, checkpoints: Sequence[Path]
) -> list[PolicyValues]:
    """Return the value maps of all policies for one start state, in one scale."""
    from scilab_rl.analysis.goal_values import painted, value_maps
    from scilab_rl.learning.inspector import VALUE, AgentInspector
    from scilab_rl.recording.callback import leave_out_impossible_pictures
    from scilab_rl.training.policy import load_policy

    inspector = AgentInspector(model)
    if VALUE not in inspector.quantities:
        return []
    leave_out_impossible_pictures(env)
    env.seed(study.settings.seed)
    start = {key: entry[0] for key, entry in env.reset().items()}  # type: ignore[union-attr]
    inner: gym.Env = env.unwrapped.envs[0]  # type: ignore[attr-defined]
    found = []
    for path in sorted({policy, *checkpoints}, key=_step_of):
        load_policy(model, path)
        found.append((_policy_name(path), value_maps(inspector, start, study.space)))
    load_policy(model, policy)
    low, high = value_range([one for _, maps in found for one in maps])
    return [
        PolicyValues(name, maps, painted(inner, study.space, maps, low, high))
        for name, maps in found
    ]


def value_range(maps: Sequence[ValueMap]) -> tuple[float, float]:
    """Return the lowest and the highest value of some maps."""
    low, high = (float(f([f(one.values) for one in maps])) for f in (np.min, np.max))
    return low, high if high > low else low + 1.0


def _step_of(policy: Path) -> int:
    from scilab_rl.training import checkpoint

    return int(checkpoint.verify(policy)["step"])


def _policy_name(policy: Path) -> str:
    return f"{policy.name.removeprefix('rl_model_')}, after {_step_of(policy):,} steps"


def _record(
    model: Algorithm,
    env: VecEnv,
    cfg: RunConfig,
    run: RunDirectory,
    study: GoalStudy,
    policy: str,
    n: int,
) -> dict[int, Link]:
    """Record failed episodes of the worst goals again; return links to their pages by episode."""
    from scilab_rl.envs.goal_setting import EpisodePlan
    from scilab_rl.learning.inspector import AgentInspector
    from scilab_rl.recording.callback import default_metrics, film_first_episode
    from scilab_rl.recording.records import FOLDER as EPISODES
    from scilab_rl.recording.records import SUFFIX, ClipInfo
    from scilab_rl.training.evaluation import evaluate_side_by_side

    folder, links, played = run.outputs / EPISODES, {}, study.played
    number = len(list(folder.glob(f"goals_*{SUFFIX}")))
    shape = env.observation_space["desired_goal"].shape  # type: ignore[index]
    metrics = default_metrics(AgentInspector(model))
    for episode in study.worst(n):
        number += 1
        plan = EpisodePlan(int(played.seeds[episode]), played.goals[episode].reshape(shape))
        clip = ClipInfo(
            f"goals_{number:03d}", "eval", 0, cfg.env, cfg.algorithm.name, 0.0, (),
            str(run) if run.is_agent else run.path.name, plan.seed, policy,
        )  # fmt: skip
        timeline, recorder = film_first_episode(env, model, metrics, clip, folder)
        [[again]] = evaluate_side_by_side(model, env, [[plan]], [1])
        timeline.close()
        recorder.close()
        outcome = "again no success" if not again.success else "success this time"
        address = os.path.relpath(folder / f"{clip.name}.html", run.outputs / FOLDER)
        links[episode] = Link(f"{clip.name} ({outcome})", Path(address).as_posix())
    return links


def _write(report: GoalReport, title: str, policy: Path, links: dict[int, Link]) -> None:
    folder = report.folder
    folder.mkdir(parents=True, exist_ok=True)
    tables = {"goals": list(cell_rows(report.study)), "episodes": list(episode_rows(report.study))}
    for name, rows in tables.items():
        write_table(rows, folder / f"{name}.csv")
        if importlib.util.find_spec("pyarrow") is not None:
            write_table(rows, folder / f"{name}.parquet")
    draw(report, folder / "goals.png", title)
    files.write_text(report.page, page(report, title, _policy_name(policy), links))


def cell_rows(study: GoalStudy) -> Iterator[dict[str, object]]:
    """Yield one row per cell for a table."""
    played, calibration = study.played, study.calibration
    n_drawn = len(study.drawn.goals)
    kinds: dict[int, list[str]] = {}
    for region in study.regions:
        for cell in region.cells.tolist():
            kinds.setdefault(cell, []).append(region.kind)
    for cell, rate in enumerate(study.rates):
        here = played.cells == cell
        places = zip(study.space.axes, study.grid.centers[cell].tolist(), strict=True)
        row: dict[str, object] = {"cell": cell, **{f"goal_{axis}": at for axis, at in places}}
        row |= {"episodes": int(here.sum()), "successes": int(study.successes[cell])}
        row |= {"success_rate": rate.value, "low": rate.low, "high": rate.high}
        if np.isfinite(played.values).all():
            row["value"] = float(played.values[here].mean())
        if calibration is not None:
            row["predicted_success"] = float(calibration.probabilities[here].mean())
        row |= {"asked": int(study.asked[cell]), "asked_share": study.asked[cell] / n_drawn}
        yield row | {"finding": "; ".join(kinds.get(cell, []))}


def episode_rows(study: GoalStudy) -> Iterator[dict[str, object]]:
    """Yield one row per episode for a table."""
    played = study.played
    for index in range(len(played.cells)):
        row: dict[str, object] = {
            "cell": int(played.cells[index]),
            "seed": int(played.seeds[index]),
        }
        for name, goals in (("desired", played.goals), ("achieved", played.achieved)):
            row |= {f"{name}_{i}": float(x) for i, x in enumerate(goals[index])}
        if np.isfinite(played.values[index]):
            row["value"] = float(played.values[index])
        yield row | {"success": bool(played.successes[index])}


def page(report: GoalReport, title: str, policy: str, links: dict[int, Link]) -> str:
    """Return the page."""
    study = report.study
    axes = [f"goal[{axis}]" for axis in study.space.axes]
    seconds = [one.seconds for values in report.values for one in values.maps]
    return render(
        "goals.html",
        title=title,
        facts=_facts(study, policy),
        findings=study.findings,
        axes=axes,
        x_range=_ends(study, 0),
        y_range=_ends(study, 1) if len(axes) > 1 else None,
        aspect=_aspect(study),
        success=_success_slices(study),
        asked=_asked_slices(study),
        success_curve=_success_curve(study) if len(axes) == 1 else None,
        values=_value_slices(report) if len(axes) > 1 else [],
        value_curves=_value_curves(report) if len(axes) == 1 else [],
        scenes=[[_as_png(s) for s in v.scenes if s is not None] for v in report.values],
        policies=[values.name for values in report.values],
        value_range=value_range([m for v in report.values for m in v.maps]) if seconds else None,
        milliseconds=1e3 * min(seconds) if seconds else None,
        calibration=study.calibration,
        reliability=_reliability(study.calibration),
        replayed=study.replayed,
        histograms=[_histogram(study.replayed, axis) for axis in study.space.axes],
        densities=_densities(study) if len(axes) > 1 else [],
        worst=(["episode", "cell's success rate", "goal", "achieved", "value"],
               list(_worst_rows(study, links))),
        files=["goals.csv", "episodes.csv", "goals.png"],
    )  # fmt: skip


def _facts(study: GoalStudy, policy: str) -> list[tuple[str, object]]:
    costs = study.costs
    facts: list[tuple[str, object]] = [
        ("policy", policy),
        ("success over the goal space", _percent(study.overall)),
        ("with the goals that are asked for", _percent(study.own)),
        ("episodes", f"{costs['episodes']:,.0f}, {study.settings.episodes} per goal"),
        ("time", f"{costs['seconds']:.0f} s ({costs['cpu_seconds']:.0f} s of CPU)"),
    ]
    if study.calibration is not None:
        facts.insert(3, ("AUC of the value", str(study.calibration.auc)))
    return facts


def _percent(rate: Any) -> str:
    return f"{rate.value:.2f} [{rate.low:.2f}, {rate.high:.2f}]"


def _ends(study: GoalStudy, column: int) -> tuple[float, float]:
    return float(study.space.low[column]), float(study.space.high[column])


def _aspect(study: GoalStudy) -> float:
    sizes = (study.space.high - study.space.low)[:2]
    return float(np.clip(sizes[0] / sizes[-1], 0.4, 2.5))


def _by_slice(study: GoalStudy, cells: np.ndarray) -> list[np.ndarray]:
    """Divide what belongs to cells into slices with the second axis as rows."""
    if len(study.space.axes) == 1:
        return []
    shaped = cells.reshape(*study.grid.shape[:2], -1)
    return [shaped[:, :, index].T for index in range(shaped.shape[2])]


def _slice_names(study: GoalStudy) -> list[str]:
    if len(study.space.axes) < 3:
        return [""]
    edges = study.grid.edges[2]
    return [f"goal[{study.space.axes[2]}] = {at:.3g}" for at in (edges[:-1] + edges[1:]) / 2]


def _success_slices(study: GoalStudy) -> list[dict[str, object]]:
    texts = np.array(
        [
            f"{rate.value:.2f} [{rate.low:.2f}, {rate.high:.2f}] at {_place(center)}; asked for in "
            f"{n} of {len(study.drawn.goals):,} resets"
            for rate, center, n in zip(study.rates, study.grid.centers, study.asked, strict=True)
        ],
        dtype=object,
    )
    rates = np.array([rate.value for rate in study.rates])
    parts = zip(_slice_names(study), _by_slice(study, rates), _by_slice(study, texts), strict=False)
    return [{"name": n, "values": v.tolist(), "texts": t.tolist()} for n, v, t in parts]


def _asked_slices(study: GoalStudy) -> list[dict[str, object]]:
    counts = study.asked.astype(float)
    parts = zip(_slice_names(study), _by_slice(study, counts), strict=False)
    return [{"name": n, "values": v.tolist(), "high": max(counts.max(), 1.0)} for n, v in parts]


def _place(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:.3g}" for number in numbers)


def _success_curve(study: GoalStudy) -> Series:
    xs = study.grid.centers[:, 0].tolist()
    mean, low, high = ([getattr(r, k) for r in study.rates] for k in ("value", "low", "high"))
    return Series("success rate", mean=(xs, mean), band=(xs, low, high))


def _value_slices(report: GoalReport) -> list[list[dict[str, object]]]:
    """Return for each policy the picture of each slice."""
    from scilab_rl.analysis.goal_values import map_picture

    low, high = value_range([one for values in report.values for one in values.maps] or [])
    axis = report.study.space.axes[-1]
    return [
        [
            {
                "name": "" if one.at is None else f"goal[{axis}] = {one.at:.3g}",
                "picture": _as_png(map_picture(one.values, low, high)),
            }
            for one in values.maps
        ]
        for values in report.values
    ]


def _value_curves(report: GoalReport) -> list[Series]:
    low, high = _ends(report.study, 0)
    curves = []
    for color, values in enumerate(report.values):
        numbers = values.maps[0].values[:, 0][:: max(1, values.maps[0].values.size // 128)]
        xs = np.linspace(low, high, len(numbers)).tolist()
        curves.append(Series(values.name, mean=(xs, numbers.tolist()), color=color))
    return curves


def _as_png(picture: np.ndarray) -> bytes:
    import io

    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def _reliability(calibration: Calibration | None) -> list[Interval]:
    return [
        Interval("", b.observed.value, b.observed.low, b.observed.high, at=b.predicted,
                 n=b.n_episodes)
        for b in (calibration.bins if calibration is not None else ())
    ]  # fmt: skip


def _histogram(replayed: ReplayedGoals, axis: int) -> list[Series]:
    """Return densities of the goals on one axis."""
    kinds = _kinds(replayed)
    together = np.concatenate([goals[:, axis] for goals in kinds.values()])
    low, high = np.quantile(together, [0.001, 0.999])
    edges = np.linspace(low, high if high > low else low + 1.0, _N_BINS + 1)
    middles = ((edges[:-1] + edges[1:]) / 2).tolist()
    return [
        Series(name, mean=(middles, (np.histogram(goals[:, axis], edges)[0] / len(goals)).tolist()),
               color=color)
        for color, (name, goals) in enumerate(kinds.items())
    ]  # fmt: skip


def _kinds(replayed: ReplayedGoals) -> dict[str, np.ndarray]:
    kinds = {
        "desired": replayed.desired, "achieved": replayed.achieved,
        "relabeled": replayed.relabeled,
    }  # fmt: skip
    return {name: goals for name, goals in kinds.items() if len(goals)}


def _densities(study: GoalStudy) -> list[dict[str, object]]:
    """Return the share of goals of each kind in each cell of the first two axes."""
    edges = study.grid.edges[:2]
    found = []
    for name, goals in _kinds(study.replayed).items():
        counts, _ = np.histogramdd(goals[:, study.space.axes[:2]], bins=edges)
        shares = counts / len(goals)
        found.append({"name": name, "values": shares.T.tolist(), "high": max(shares.max(), 1e-9),
                      "outside": max(1 - shares.sum(), 0.0)})  # fmt: skip
    return found


def _worst_rows(study: GoalStudy, links: dict[int, Link]) -> Iterator[list[object]]:
    for episode in study.worst(max(len(links), 10)):
        rate = study.rates[study.played.cells[episode]]
        value = float(study.played.values[episode])
        yield [
            links.get(episode, "not recorded"),
            _percent(rate),
            _place(study.played.goals[episode]),
            _place(study.played.achieved[episode]),
            value if np.isfinite(value) else None,
        ]


def draw(report: GoalReport, path: Path, title: str) -> None:
    """Draw success, values, the scene and the reliability curve into one picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    success, value, scene, reliability = figure.subplots(1, 4)
    figure.suptitle(title)
    _draw_success(report.study, success)
    _draw_values(report, value)
    picture = next((s for v in report.values[-1:] for s in v.scenes if s is not None), None)
    scene.axis("off")
    if picture is not None:
        scene.imshow(picture)
        scene.set_title("the value in the scene")
    _draw_reliability(report.study.calibration, reliability)
    figure.savefig(path, dpi=110)


def _draw_success(study: GoalStudy, axes: Axes) -> None:
    rates = np.array([rate.value for rate in study.rates])
    axes.set_title("success rate" + (f", {_slice_names(study)[0]}" if study.grid.shape[2:] else ""))
    axes.set_xlabel(f"goal[{study.space.axes[0]}]")
    if len(study.space.axes) == 1:
        low, high = ([getattr(rate, end) for rate in study.rates] for end in ("low", "high"))
        axes.fill_between(study.grid.centers[:, 0], low, high, alpha=0.2, linewidth=0)
        axes.plot(study.grid.centers[:, 0], rates)
        axes.set_ylim(-0.03, 1.03)
        return
    axes.set_ylabel(f"goal[{study.space.axes[1]}]")
    drawn = axes.pcolormesh(*study.grid.edges[:2], _by_slice(study, rates)[0], vmin=0, vmax=1)
    axes.figure.colorbar(drawn, ax=axes)


def _draw_values(report: GoalReport, axes: Axes) -> None:
    study = report.study
    axes.set_title("value of a start state")
    axes.set_xlabel(f"goal[{study.space.axes[0]}]")
    if not report.values:
        axes.text(0.5, 0.5, "the algorithm has none", ha="center", transform=axes.transAxes)
        return
    values = report.values[-1].maps[0].values
    ends = _ends(study, 0)
    if len(study.space.axes) == 1:
        axes.plot(np.linspace(*ends, len(values)), values[:, 0])
        return
    axes.set_ylabel(f"goal[{study.space.axes[1]}]")
    drawn = axes.imshow(values.T, origin="lower", extent=(*ends, *_ends(study, 1)), aspect="auto")
    axes.figure.colorbar(drawn, ax=axes)


def _draw_reliability(calibration: Calibration | None, axes: Axes) -> None:
    axes.set_title("does the value predict success?")
    axes.set_xlabel("predicted")
    axes.set_ylabel("observed")
    axes.plot([0, 1], [0, 1], color="#a1a1aa", linewidth=1)
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    for one in calibration.bins if calibration is not None else ():
        axes.plot([one.predicted] * 2, [one.observed.low, one.observed.high], color="#2563eb")
        axes.plot(one.predicted, one.observed.value, "o", color="#2563eb")
