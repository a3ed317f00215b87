"""``scilab-rl dataset ENVIRONMENT``: data sets for offline learning, in Minari's format."""

from __future__ import annotations

import argparse
import logging

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError

_log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    from scilab_rl.api.datasets import DatasetSettings, write_dataset
    from scilab_rl.envs.registration import resolve_env_id

    options = _parse(arguments)
    open_project()
    env, notice = resolve_env_id(options.env)
    if notice:
        _log.info(notice)
    cfg = RunConfig(env, base_logdir=str(options.base_logdir))
    agent = options.agent or f"agent:{options.env.rpartition(':')[2].partition('-')[0]}"
    for kind in options.kinds:
        settings = DatasetSettings(
            cfg, kind, agent, options.episodes, options.random_share, options.seed, options.license
        )
        folder, success = write_dataset(settings)
        _log.info("%s: %d episodes, success %s", folder, options.episodes, success)
    return 0


def _parse(arguments: list[str]) -> argparse.Namespace:
    from scilab_rl.api.datasets import KINDS

    parser = CommandParser(
        "dataset",
        "Write data sets for offline learning in Minari's format: expert (an agent's most likely "
        "actions), medium (the same, a share of them random), scripted, random; with cards.",
        base=True,
    )
    add = parser.add_argument
    add("env", help="the environment, for example FetchPush")
    add("kinds", nargs="*", metavar="KIND", help=f"{', '.join(KINDS)}; default: all of them")
    add("--agent", metavar="RUN", help="of expert and medium; default: agent:ENVIRONMENT")
    add("--episodes", type=positive, default=1000, help="of each set; default: 1000")
    add("--random-share", type=float, default=0.5, help="of medium's actions; default: 0.5")
    add("--seed", type=int, default=0, help="of the episodes; default: 0")
    add("--license", default="MIT", help="default: MIT, as Scilab-RL")
    options = parser.parse_args(arguments)
    options.kinds = options.kinds or list(KINDS)
    for kind in options.kinds:
        if kind not in KINDS:
            raise ConfigError(f"There is no data set '{kind}'; there are {', '.join(KINDS)}.")
    if not 0 < options.random_share < 1:
        raise ConfigError(
            f"--random-share must be between 0 and 1, but it is {options.random_share:g}."
        )
    return options
