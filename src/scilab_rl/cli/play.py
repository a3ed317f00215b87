"""``scilab-rl play RUN``: run a trained policy, record it, and measure its success."""

from __future__ import annotations

import argparse
import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.api.agent import Agent, EvaluationSummary, find
from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError
from scilab_rl.files import shown
from scilab_rl.run.directory import RunDirectory, all_agents

if TYPE_CHECKING:  # heavy
    from scilab_rl.training.evaluation import Episode

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    options = _parse(arguments)
    with _find(options) as agent:
        agent.cfg = replace(agent.cfg, render_view=options.view or agent.cfg.render_view)
        summary = agent.evaluate(
            options.episodes,
            seed=options.seed or None,
            deterministic=not options.stochastic,
            record=options.record,
            metrics=options.metrics.split(",") if options.metrics else None,
            on_episode=_log_episode,
        )
    _report(summary, agent.cfg)
    return 0


def _find(options: argparse.Namespace) -> Agent:
    """Return the agent to play.

    A zip of Stable-Baselines3 has no run; its algorithm and environment are on the command line.

    Raises:
        ConfigError: If there is no such policy, or it is a zip that is not trusted.
    """
    from scilab_rl.training import sb3_archives

    archive = sb3_archives.find_archive(Path(options.run))
    if archive is not None:
        sb3_archives.refuse_untrusted(archive)
        open_project()
        cfg = _composed_for(archive, options.overrides)
        return Agent(RunDirectory(archive.parent), cfg, archive)
    if options.overrides:
        raise ConfigError(
            f"'{options.overrides[0]}' applies only to zips of Stable-Baselines3; a run keeps "
            "its configuration."
        )
    return find(options.run, options.policy, options.base_logdir)


def _composed_for(archive: Path, overrides: list[str]) -> RunConfig:
    from scilab_rl.config.compose import compose

    given = {override.partition("=")[0] for override in overrides}
    if not {"algorithm", "env"} <= given:
        raise ConfigError(
            f"'{archive}' requires its algorithm and environment, for example: "
            f"scilab-rl play {archive} algorithm=sac env=FetchReach --trust-pickle"
        )
    return compose(overrides)


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
    parser.add_argument(
        "--view",
        choices=("task", "close"),
        help="close: a plain background and a nearer camera, for MuJoCo tasks",
    )
    parser.add_argument("--policy", choices=("best", "finished"), default="best")
    parser.add_argument("--stochastic", action="store_true", help="sample actions")
    parser.add_argument("--seed", type=int, default=0, help="default: the run's seed plus 1")
    return parser.parse_args(arguments)


def _log_episode(episode: Episode) -> None:
    outcome = {None: "", True: "  success", False: "  no success"}[episode.success]
    _log.info("%3d steps  return %.3g%s", len(episode.rewards), sum(episode.rewards), outcome)


def _report(summary: EvaluationSummary, cfg: RunConfig) -> None:
    from scilab_rl.tracking.console import print_table

    returns, success = summary.returns, summary.success
    rows = [("environment", cfg.env), ("algorithm", cfg.algorithm.name)]
    rows.append(("episodes", str(summary.n_episodes)))
    if success is not None:
        interval = f"95 % interval {success.low:.2f} to {success.high:.2f}"
        rows.append(("success", f"{success.value:.2f} ({interval})"))
    if n_silent := int(summary.metrics.get("eval/success_not_reported", 0)):
        rows.append(("not reported", f"{n_silent} episodes, counted as not successful"))
    rows.append(
        ("return", f"{returns.mean():.3g} (from {returns.min():.3g} to {returns.max():.3g})")
    )
    if summary.replay is not None and summary.replay.video.is_file():
        rows.append(("video", shown(summary.replay.video)))
    sys.stdout.flush()
    print_table(rows)
