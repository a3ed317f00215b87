"""From a recording and a question to the report that is shown."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scilab_rl.analysis.whatif import Change, Decision, Future, FuturePlayer, find_decision
from scilab_rl.analysis.whatif_page import Report, draw, write_page, write_tables
from scilab_rl.analysis.whatif_scenes import ScenePictures, recorded_pictures, render_scenes
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_copies
from scilab_rl.errors import ConfigError
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.recording.records import Clip, load_clip
from scilab_rl.run.checks import complete
from scilab_rl.run.parts import render_mode
from scilab_rl.run.player import load_player

_log = logging.getLogger(__name__)
_MOST_ENVS = 24  # side by side; more would take longer to make than they save
_MOST_SCENES = 50  # that are asked about by default


def ask(
    cfg: RunConfig,
    policy: Path,
    recording: Path,
    change: Change,
    *,
    scene: int | None,
    n_futures: int = 20,
    every: int | None = None,
    question: str = "",
) -> Report:
    """Play other futures of a recorded episode.

    Args:
        cfg: The configuration of its run.
        policy: The saved policy that acts in the futures.
        recording: The file of the episode.
        change: What differs from the episode.
        scene: From which scene on; None: from every scene, to find when it was decided.
        n_futures: Of each scene.
        every: Steps between the scenes; None: so many that there are at most 50.
        question: The title of the page.

    Raises:
        ConfigError: If the episode cannot be repeated, or the question does not fit the task.
    """
    clip = load_clip(recording)
    env, model = load_player(cfg, policy, record=False)
    env.close()
    n_envs = _MOST_ENVS if scene is None else min(_MOST_ENVS, max(n_futures, 2))
    envs = make_copies(complete(cfg), n_envs)
    try:
        player = FuturePlayer(AgentInspector(model), envs, clip)
        futures, decision = _futures(player, clip, change, scene, n_futures, every)
        scenes = sorted({future.scene for future in futures})
        likely = dict(zip(scenes, player.play(scenes, change, deterministic=True), strict=True))
        happened = player.happened(clip)
        drawn = [happened, *futures]
        pictures = _pictures(cfg, player, clip, scenes, drawn, change.goal)
    finally:
        for each in envs:
            each.close()
    facts = _facts(clip, happened, player, change, n_futures, policy)
    return Report(clip, facts, question, happened, likely, futures, decision, pictures, change.goal)


def write_report(report: Report, page: Path) -> None:
    """Write the page, with tables and picture of the same name next to it."""
    page.parent.mkdir(parents=True, exist_ok=True)
    write_tables(report, page.with_suffix(".csv"))
    draw(report, page.with_suffix(".png"))
    write_page(report, page)


def _futures(
    player: FuturePlayer,
    clip: Clip,
    change: Change,
    scene: int | None,
    n_futures: int,
    every: int | None,
) -> tuple[list[Future], Decision | None]:
    n_steps = len(player.scenes) - 1
    if scene is None:
        every = every or -(-n_steps // _MOST_SCENES)
        _log.info("%d futures of each scene of %d steps ...", n_futures, n_steps)
        return find_decision(player, clip, change, n_futures=n_futures, every=every)
    if scene >= n_steps:
        raise ConfigError(
            f"--at: scene {scene} has no future; the episode has scenes 0 to {n_steps - 1} with a "
            "step after them."
        )
    return player.play([scene] * n_futures, change), None


def _pictures(
    cfg: RunConfig,
    player: FuturePlayer,
    clip: Clip,
    scenes: Sequence[int],
    futures: Sequence[Future],
    goal: np.ndarray | None,
) -> ScenePictures:
    """Return the pictures of the scenes: rendered from near, or those that were recorded."""
    recorded = recorded_pictures(clip, scenes)
    if clip.records[0].state is None or not recorded.pictures[scenes[0]]:
        return recorded
    [env] = make_copies(complete(cfg), 1, render_mode("record"))
    try:
        return render_scenes(env, player.scenes, scenes, futures, goal) or recorded
    finally:
        env.close()


def _facts(
    clip: Clip,
    happened: Future,
    player: FuturePlayer,
    change: Change,
    n_futures: int,
    policy: Path,
) -> list[tuple[str, object]]:
    outcome = {None: "no success reported", True: "success", False: "failure"}[happened.success]
    sigma = player.sigma_of(change)
    name = policy.name.removeprefix("rl_model_")
    return [
        ("episode", clip.info.name),
        ("outcome", outcome),
        ("return", float(sum(happened.rewards))),
        ("steps", len(happened.rewards)),
        ("policy of the futures", f"{policy.parent.name}, {name}"),
        ("noise", f"sampled actions, sigma {sigma:g}" if sigma else "sampled actions"),
        ("futures per scene", n_futures),
        ("seed of the noise", change.seed),
        ("put back by", "state" if player.scenes.is_fast else "replay"),
    ]
