"""``scilab-rl play RUN``: run a trained policy, record it, and measure its success."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.analysis.estimates import success_interval
from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import (
    CONFIG_FILE,
    RunDirectory,
    all_agents,
    find_policy,
    find_run,
    reports_success,
)
from scilab_rl.run.player import load_player

if TYPE_CHECKING:  # heavy
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.training.evaluation import Episode, Evaluation

_log = logging.getLogger(__name__)
# By default, the first supported metric of each row is drawn.
_DEFAULT_METRICS = (("q_values", "value"), ("critic_variance",), ("goal_distance",), ("reward",))


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_project()
    run, cfg, policy = _find(options)
    seed = options.seed or int(cfg.seed) + 1
    env, model = load_player(cfg, policy, record=options.record)
    finish = film_first_episode(model, env, cfg, run, options.metrics) if options.record else None
    evaluation = _play(model, env, options, seed)
    video = finish() if finish is not None else None
    env.close()
    _report(evaluation.metrics(reports_success=reports_success(run)), evaluation, cfg, video)
    return 0


def _find(options: argparse.Namespace) -> tuple[RunDirectory, RunConfig, Path]:
    """Return the run, its configuration and the saved policy to play.

    A zip of Stable-Baselines3 has no run; its algorithm and environment are on the command line.

    Raises:
        ConfigError: If there is no such policy, or it is a zip that is not trusted.
    """
    from scilab_rl.training import sb3_archives

    archive = sb3_archives.find_archive(Path(options.run))
    if archive is not None:
        sb3_archives.refuse_untrusted(archive)
        return RunDirectory(archive.parent), _composed_for(archive, options.overrides), archive
    if options.overrides:
        raise ConfigError(
            f"'{options.overrides[0]}' applies only to zips of Stable-Baselines3; a run keeps "
            "its configuration."
        )
    run = find_run(options.run, options.base_logdir)
    policy = find_policy(run, options.run, options.policy, "best", "finished")
    return run, load_recorded(run / CONFIG_FILE), policy


def _composed_for(archive: Path, overrides: list[str]) -> RunConfig:
    from scilab_rl.config.compose import compose

    given = {override.partition("=")[0] for override in overrides}
    if not {"algorithm", "env"} <= given:
        raise ConfigError(
            f"'{archive}' requires its algorithm and environment, for example: "
            f"scilab-rl play {archive} algorithm=sac env=FetchReach --trust-pickle"
        )
    return compose(overrides)


def default_metrics(model: Algorithm) -> list[str]:
    """Return the most informative metrics that an algorithm supports."""
    from scilab_rl.learning.inspector import AgentInspector
    from scilab_rl.metrics.probes import answerable

    possible = answerable(AgentInspector(model))
    chosen = (next((name for name in row if name in possible), None) for row in _DEFAULT_METRICS)
    return [name for name in chosen if name is not None]


def film_first_episode(
    model: Algorithm, env: VecEnv, cfg: RunConfig, run: RunDirectory, metrics: str
) -> Callable[[], Path]:
    """Prepare the recording of the next episode.

    Returns:
        A function that ends the recording and returns the path of the video.
    """
    from scilab_rl.recording import callback
    from scilab_rl.recording.records import FOLDER, SUFFIX, ClipInfo

    folder = run.outputs / FOLDER
    number = len(list(folder.glob(f"play_*{SUFFIX}"))) + 1
    clip = ClipInfo(f"play_{number:03d}", "eval", 0, cfg.env, cfg.algorithm.name, 0.0, ())
    names = metrics.split(",") if metrics else default_metrics(model)
    timeline, recorder = callback.film_first_episode(env, model, names, clip, folder)

    def finish() -> Path:
        timeline.close()
        recorder.close()
        return folder / f"{clip.name}.mp4"

    return finish


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = CommandParser(
        "play",
        "Run a trained policy and report its success rate with a 95 % interval.",
        run=True,
        base=True,
    )
    parser.epilog = f"Trained agents, as RUN: {', '.join(f'agent:{name}' for name in all_agents())}"
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="KEY=VALUE",
        help="for a zip of Stable-Baselines3 (with --trust-pickle): algorithm=sac env=FetchReach",
    )
    parser.add_argument("--episodes", type=positive, default=10, help="how many (default 10)")
    parser.add_argument("--record", action="store_true", help="record the first episode")
    parser.add_argument(
        "--metrics", default="", help="shown in the video: q_value,critic_variance,..."
    )
    parser.add_argument("--policy", choices=("best", "finished"), default="best")
    parser.add_argument("--stochastic", action="store_true", help="sample actions")
    parser.add_argument("--seed", type=int, default=0, help="default: the run's seed plus 1")
    return parser.parse_args(arguments)


def _play(model: Algorithm, env: VecEnv, options: argparse.Namespace, seed: int) -> Evaluation:
    from scilab_rl.training.evaluation import evaluate

    def log(episode: Episode) -> None:
        outcome = {None: "", True: "  success", False: "  no success"}[episode.success]
        _log.info("%3d steps  return %.3g%s", len(episode.rewards), sum(episode.rewards), outcome)

    return evaluate(
        model,
        env,
        options.episodes,
        seed,
        deterministic=not options.stochastic,
        on_episode=log,
    )


def _report(
    values: Mapping[str, float], evaluation: Evaluation, cfg: RunConfig, video: Path | None
) -> None:
    from scilab_rl.tracking.console import print_table

    episodes = evaluation.episodes
    returns = [sum(episode.rewards) for episode in episodes]
    rows = [("environment", cfg.env), ("algorithm", cfg.algorithm.name)]
    rows.append(("episodes", str(len(episodes))))
    if (rate := values.get("eval/success_rate")) is not None:
        found = success_interval(round(rate * len(episodes)), len(episodes))
        interval = f"95 % interval {found.low:.2f} to {found.high:.2f}"
        rows.append(("success", f"{rate:.2f} ({interval})"))
    if n_silent := int(values.get("eval/success_not_reported", 0)):
        rows.append(("not reported", f"{n_silent} episodes, counted as not successful"))
    rows.append(
        ("return", f"{np.mean(returns):.3g} (from {min(returns):.3g} to {max(returns):.3g})")
    )
    if video is not None and video.is_file():
        rows.append(("video", str(video)))
    sys.stdout.flush()
    print_table(rows)
