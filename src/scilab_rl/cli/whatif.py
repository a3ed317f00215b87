"""``scilab-rl whatif RUN --episode E --at T``: other futures of a recorded episode."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.cli.play import film_first_episode
from scilab_rl.cli.view import chosen_recordings
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError
from scilab_rl.recording.records import FOLDER as EPISODES
from scilab_rl.recording.records import SUFFIX
from scilab_rl.run.checks import complete
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, find_policy, find_run, slug
from scilab_rl.run.player import load_player

if TYPE_CHECKING:  # heavy
    from scilab_rl.analysis.whatif import Change, Future, FuturePlayer
    from scilab_rl.analysis.whatif_page import Report
    from scilab_rl.analysis.whatif_scenes import ScenePictures
    from scilab_rl.recording.records import Clip

_log = logging.getLogger(__name__)
_N_ENVS = 24  # side by side; more would take longer to make than they save
_MOST_SCENES = 50  # that are asked about by default
_MOST_SEEDS = 200
_POLICIES = ("finished", "best")
FOLDER = "whatif"


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_project()
    from scilab_rl.analysis.whatif_page import draw, verdict, write_page, write_tables

    run = find_run(options.run, options.base_logdir)
    cfg = load_recorded(run / CONFIG_FILE)
    recording = _recording(run, cfg, options)
    report = _ask(run, cfg, recording, options)
    page = run.outputs / FOLDER / f"{recording.stem}_{_name(options)}.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    write_page(report, page)
    write_tables(report, page.with_suffix(".csv"))
    draw(report, page.with_suffix(".png"))
    _log.info("%s", verdict(report))
    _log.info("%s", page)
    return 0


def _recording(run: RunDirectory, cfg: RunConfig, options: argparse.Namespace) -> Path:
    """Return the recording that is asked for; record an episode where there is none."""
    is_new = options.seed is not None or options.failed
    if not is_new and (options.episode or _has_recordings(run)):
        return chosen_recordings(run, options.episode or "last")[-1]
    from scilab_rl.training.evaluation import evaluate

    policy = find_policy(run, "best", "finished")
    seed = int(cfg.seed) + 1 if options.seed is None else options.seed
    seed = _failing_seed(cfg, policy, seed) if options.failed else seed
    _log.info("Recording an episode with seed %d ...", seed)
    env, model = load_player(cfg, policy, record=True)
    finish = film_first_episode(model, env, cfg, run, "")
    evaluate(model, env, 1, seed)
    video = finish()
    env.close()
    return video.with_suffix(".npz")


def _failing_seed(cfg: RunConfig, policy: Path, first: int) -> int:
    """Return the first seed whose episode fails."""
    from scilab_rl.training.evaluation import evaluate

    env, model = load_player(cfg, policy, record=False)
    try:
        for seed in range(first, first + _MOST_SEEDS):
            if evaluate(model, env, 1, seed).episodes[0].success is False:
                return seed
    finally:
        env.close()
    raise ConfigError(
        f"None of {_MOST_SEEDS} episodes fails (seeds {first} to {first + _MOST_SEEDS - 1}); "
        "--seed N records one that succeeds."
    )


def _has_recordings(run: RunDirectory) -> bool:
    return any((run.outputs / EPISODES).glob(f"*{SUFFIX}"))


def _ask(run: RunDirectory, cfg: RunConfig, recording: Path, options: argparse.Namespace) -> Report:
    from scilab_rl.analysis.whatif import FuturePlayer, find_decision
    from scilab_rl.analysis.whatif_page import Report
    from scilab_rl.envs.vectorize import make_copies
    from scilab_rl.learning.inspector import AgentInspector
    from scilab_rl.recording.records import load_clip

    clip = load_clip(recording)
    policy = find_policy(run, *([options.checkpoint] if options.checkpoint else _POLICIES))
    env, model = load_player(cfg, policy, record=False)
    env.close()
    envs = make_copies(complete(cfg), _N_ENVS)
    player = FuturePlayer(AgentInspector(model), envs, clip)
    change, decision = _change(options), None
    if options.decided:
        n_steps = len(player.scenes) - 1
        every = options.every or -(-n_steps // _MOST_SCENES)
        _log.info("%d futures of every %s of %d scenes ...", options.futures, every, n_steps)
        futures, decision = find_decision(
            player, clip, change, n_futures=options.futures, every=every
        )
    else:
        scene = _existing_scene(options.at, len(player.scenes) - 1)
        futures = player.play([scene] * options.futures, change)
    scenes = sorted({future.scene for future in futures})
    likely = dict(zip(scenes, player.play(scenes, change, deterministic=True), strict=True))
    for each in envs:
        each.close()
    happened = player.happened(clip)
    pictures = _pictures(cfg, player, clip, scenes, [happened, *futures], change.goal)
    return Report(
        clip, _facts(run, policy, clip, happened, player, options), _question(options),
        happened, likely, futures, decision, pictures, change.goal,
    )  # fmt: skip


def _existing_scene(scene: int, n_steps: int) -> int:
    if scene >= n_steps:
        raise ConfigError(
            f"--at: scene {scene} has no future; the episode has scenes 0 to {n_steps - 1} with a "
            "step after them."
        )
    return scene


def _pictures(
    cfg: RunConfig,
    player: FuturePlayer,
    clip: Clip,
    scenes: Sequence[int],
    futures: Sequence[Future],
    goal: np.ndarray | None,
) -> ScenePictures:
    """Return the pictures of the scenes: rendered from near, or those that were recorded."""
    from scilab_rl.analysis.whatif_scenes import recorded_pictures, render_scenes
    from scilab_rl.envs.vectorize import make_copies
    from scilab_rl.run.parts import render_mode

    recorded = recorded_pictures(clip, scenes)
    if clip.records[0].state is None or not recorded.pictures[scenes[0]]:
        return recorded
    [env] = make_copies(complete(cfg), 1, render_mode("record"))
    try:
        return render_scenes(env, player.scenes, scenes, futures, goal) or recorded
    finally:
        env.close()


def _facts(
    run: RunDirectory,
    policy: Path,
    clip: Clip,
    happened: Future,
    player: FuturePlayer,
    options: argparse.Namespace,
) -> list[tuple[str, object]]:
    outcome = {None: "no success reported", True: "success", False: "failure"}[happened.success]
    sigma = player.sigma_of(_change(options))
    return [
        ("episode", clip.info.name),
        ("outcome", outcome),
        ("return", float(sum(happened.rewards))),
        ("steps", len(happened.rewards)),
        ("policy of the futures", f"{run.path.name}, {policy.name.removeprefix('rl_model_')}"),
        ("noise", "sampled actions" if not sigma else f"sampled actions, sigma {sigma:g}"),
        ("futures per scene", options.futures),
        ("seed of the noise", options.noise),
        ("put back by", "state" if player.scenes.is_fast else "replay"),
    ]


def _change(options: argparse.Namespace) -> Change:
    from scilab_rl.analysis.whatif import Change

    return Change(options.goal, options.action, options.steps, options.sigma, options.noise)


def _question(options: argparse.Namespace) -> str:
    """Return what is asked, as the page's title."""
    parts = []
    if options.goal is not None:
        parts.append(f"the goal were {_numbers_text(options.goal)}")
    if options.action is not None:
        steps = "one step" if options.steps == 1 else f"{options.steps} steps"
        parts.append(f"it did {_numbers_text(options.action)} for {steps}")
    if options.checkpoint:
        parts.append(f"{options.checkpoint} acted")
    if not parts:
        return "when was it decided?" if options.decided else f"what if? From scene {options.at}"
    return f"what if {' and '.join(parts)}?"


def _name(options: argparse.Namespace) -> str:
    parts = ["decided" if options.decided else f"at_{options.at}"]
    parts += [f"goal_{_numbers_text(options.goal)}"] if options.goal is not None else []
    if options.action is not None:
        parts.append(f"action_{_numbers_text(options.action)}_{options.steps}")
    parts += [Path(options.checkpoint).name] if options.checkpoint else []
    parts += [f"noise_{options.noise}"] if options.noise else []
    return slug("_".join(parts))


def _numbers_text(numbers: np.ndarray) -> str:
    return ",".join(f"{number:g}" for number in np.ravel(numbers))


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "whatif", "Put a recorded episode back into a scene and play other futures.", run=True,
        base=True,
    )  # fmt: skip
    add = parser.add_argument
    add(
        "--episode", help="number or name (default: the last one; if there is none, it is recorded)"
    )
    add("--seed", type=int, help="record a new episode with this seed")
    add("--failed", action="store_true", help="record the next episode that fails")
    add("--at", type=int, default=0, metavar="T", help="scene from which on it differs (default 0)")
    add("--decided", action="store_true", help="from every scene: when was the episode decided?")
    add("--every", type=positive, metavar="K", help="with --decided: steps between the scenes")
    add("--goal", type=_numbers, metavar="X,Y,...", help="another desired goal")
    add("--action", type=_numbers, metavar="A,B,...", help="another first action")
    add("--steps", type=positive, default=1, help="for how many steps that action (default 1)")
    add("--checkpoint", help="another policy: best, finished, agent:NAME or a path")
    add("--futures", type=positive, default=20, metavar="N", help="of each scene (default 20)")
    add("--noise", type=int, default=0, metavar="SEED", help="seed of all noise (default 0)")
    add("--sigma", type=float, help="Gaussian noise added to actions, in halves of their range")
    options = parser.parse_args(arguments)
    if options.at < 0:
        parser.error(f"--at: a scene has a number from 0, but it is {options.at}")
    return options


def _numbers(text: str) -> np.ndarray:
    """Convert numbers separated by commas.

    Raises:
        argparse.ArgumentTypeError: If they are none.
    """
    try:
        return np.array([float(part) for part in text.strip("[]").split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"must be numbers separated by commas, but it is '{text}'"
        ) from error
