"""``scilab-rl play RUN``: let a trained policy act, film it, and measure its success."""

from __future__ import annotations

import argparse
import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scilab_rl.config import load_recorded
from scilab_rl.errors import ConfigError
from scilab_rl.results import CONFIG_FILE, RunDirectory, find_run
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)
# The first of each row that an algorithm can answer is drawn when nothing else is asked for.
_TELLING = (("q_values", "value"), ("critic_variance",), ("goal_distance",), ("reward",))
_SMALL_BUFFER = 1000  # a policy that only acts needs no replay buffer


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    open_desk()
    run, cfg, policy = find_policy(options)
    seed = options.seed or int(cfg.seed) + 1
    env, model = load_player(cfg, policy, record=options.record)
    finish = film_first_episode(model, env, cfg, run, options.metrics) if options.record else None
    evaluation = _play(model, env, options, seed)
    video = finish() if finish is not None else None
    env.close()
    _report(evaluation, cfg, video)
    return 0


def find_policy(options: argparse.Namespace) -> tuple[RunDirectory, Any, Path]:
    """Return the run, its configuration and the saved policy that are to be played.

    A zip of Stable-Baselines3 belongs to no run: what it was trained with is on the command line.

    Raises:
        ConfigError: If there is no such policy, or it is a zip that is not trusted.
    """
    from scilab_rl.training import foreign

    archive = foreign.find_archive(Path(options.run))
    if archive is not None:
        foreign.refuse_untrusted(archive)
        return RunDirectory(archive.parent), _composed_for(archive, options.overrides), archive
    if options.overrides:
        raise ConfigError(
            f"'{options.overrides[0]}' is for zips of Stable-Baselines3; a run is played as it was "
            "trained."
        )
    run = find_run(options.run, options.base_logdir)
    return run, load_recorded(run / CONFIG_FILE), policy_folder(run, options)


def _composed_for(archive: Path, overrides: list[str]) -> Any:
    import hydra

    from scilab_rl.config import compose, friendly_override

    given = {override.partition("=")[0] for override in overrides}
    if not {"algorithm", "env"} <= given:
        raise ConfigError(
            f"What was '{archive}' trained with? For example: "
            f"scilab-rl play {archive} algorithm=sac env=FetchReach --trust-pickle"
        )
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        return compose([friendly_override(override) for override in overrides])


def policy_folder(run: RunDirectory, options: argparse.Namespace) -> Path:
    """Return the saved policy that was asked for, or the best one there is.

    Raises:
        ConfigError: If the run has saved none.
    """
    if (Path(options.run) / "manifest.json").is_file():
        return Path(options.run)
    names = [f"rl_model_{options.policy}", "rl_model_best", "rl_model_finished"]
    for name in names:
        if (run / name).is_dir():
            return run / name
    raise ConfigError(f"The run '{run}' has not saved a policy yet: it needs one epoch.")


def load_player(cfg: Any, folder: Path, *, record: bool) -> tuple[Any, Any]:
    """Make the evaluation environment of a run and the algorithm with its saved weights."""
    from scilab_rl import assembly
    from scilab_rl.envs.vectorize import make_eval_env
    from scilab_rl.training.trainer import load_policy

    cfg = assembly.complete(cfg)
    assembly.prepare_torch(cfg)
    settings = assembly.env_settings(cfg)
    env = make_eval_env(
        replace(settings, render_mode=assembly.render_mode("record" if record else "none"))
    )
    if "buffer_size" in cfg.algorithm:
        cfg.algorithm.buffer_size = min(cfg.algorithm.buffer_size, _SMALL_BUFFER)
    model = assembly.make_algorithm(cfg, env)
    load_policy(model, folder)
    return env, model


def telling_metrics(model: Any) -> list[str]:
    """Return the metrics that say most about an algorithm, of those that it can answer."""
    from scilab_rl.algorithms.inspection import Inspection
    from scilab_rl.metrics.probes import answerable

    possible = answerable(Inspection(model))
    chosen = (next((name for name in row if name in possible), None) for row in _TELLING)
    return [name for name in chosen if name is not None]


def film_first_episode(model: Any, env: Any, cfg: Any, run: RunDirectory, metrics: str) -> Any:
    """Prepare the recording of the next episode; the result returns its video when called."""
    from scilab_rl.training import showing
    from scilab_rl.visualization.archive import FOLDER, SUFFIX
    from scilab_rl.visualization.records import ClipInfo

    if not showing.can_draw(env):
        return lambda: None
    folder = run / FOLDER
    number = len(list(folder.glob(f"play_*{SUFFIX}"))) + 1
    clip = ClipInfo(f"play_{number:03d}", "eval", 0, cfg.env, cfg.algorithm.name, 0.0, ())
    names = metrics.split(",") if metrics else telling_metrics(model)
    timeline, recorder = showing.film_first_episode(env, model, names, clip, folder)

    def finish() -> Path:
        timeline.close()
        recorder.close()
        return folder / f"{clip.name}.mp4"

    return finish


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="scilab-rl play",
        description="Let a trained policy act and report its success rate with a 95 % interval.",
    )
    parser.add_argument("run", help="'last', the path of a run or policy, or a part of its name")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="KEY=VALUE",
        help="for a zip of Stable-Baselines3 (with --trust-pickle): algorithm=sac env=FetchReach",
    )
    parser.add_argument("--episodes", type=_positive, default=10, help="how many (default 10)")
    parser.add_argument("--record", action="store_true", help="film the first episode")
    parser.add_argument(
        "--metrics", default="", help="drawn beside it: q_value,critic_variance,..."
    )
    parser.add_argument("--policy", choices=("best", "finished"), default="best")
    parser.add_argument("--stochastic", action="store_true", help="sample actions")
    parser.add_argument("--seed", type=int, default=0, help="default: the run's seed plus 1")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"))
    return parser.parse_args(arguments)


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, but it is {number}")
    return number


def _play(model: Any, env: Any, options: argparse.Namespace, seed: int) -> Any:
    from scilab_rl.training.evaluation import evaluate

    def show(episode: Any) -> None:
        outcome = {None: "", True: "  success", False: "  no success"}[episode.success]
        _log.info("%3d steps  return %.3g%s", len(episode.rewards), sum(episode.rewards), outcome)

    return evaluate(
        model,
        env,
        options.episodes,
        seed,
        deterministic=not options.stochastic,
        on_episode=show,
    )


def _report(evaluation: Any, cfg: Any, video: Path | None) -> None:
    from scilab_rl.tracking.console import print_table
    from scilab_rl.training.evaluation import wilson_interval

    episodes = evaluation.episodes
    returns = [sum(episode.rewards) for episode in episodes]
    rows = [("environment", cfg.env), ("algorithm", cfg.algorithm.name)]
    rows.append(("episodes", str(len(episodes))))
    if all(episode.success is not None for episode in episodes):
        successes = sum(bool(episode.success) for episode in episodes)
        low, high = wilson_interval(successes, len(episodes))
        rate = successes / len(episodes)
        rows.append(("success", f"{rate:.2f} (95 % interval {low:.2f} to {high:.2f})"))
    rows.append(
        ("return", f"{np.mean(returns):.3g} (from {min(returns):.3g} to {max(returns):.3g})")
    )
    if video is not None and video.is_file():
        rows.append(("video", str(video)))
    sys.stdout.flush()
    print_table(rows)
