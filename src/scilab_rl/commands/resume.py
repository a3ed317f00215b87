"""``scilab-rl resume RUN [KEY=VALUE ...]``: continue a run from its newest checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scilab_rl.commands.parser import CommandParser
from scilab_rl.config import load_recorded
from scilab_rl.errors import ConfigError
from scilab_rl.results import CONFIG_FILE, find_run
from scilab_rl.workspace import open_desk

# What a checkpoint is made of; the rest of the configuration may change in the middle of a run.
_FIXED = ("algorithm", "env", "env_kwargs", "wrappers", "n_envs", "seed", "restore_policy")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("resume", "Continue a run exactly where its newest checkpoint was made.")
    parser.add_argument("run", help="'last', the path of a run, or a part of its name")
    parser.add_argument("overrides", nargs="*", help="changes, for example n_epochs=100")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"))
    options = parser.parse_args(arguments)
    refuse_fixed_keys(options.overrides)

    from scilab_rl import experiment

    open_desk()
    directory = find_run(options.run, options.base_logdir)
    cfg = load_recorded(directory / CONFIG_FILE, options.overrides)
    return experiment.resume(cfg, directory).exit_code


def refuse_fixed_keys(overrides: Sequence[str]) -> None:
    """Refuse changes that would make another run of it.

    Raises:
        ConfigError: If a key belongs to what the checkpoint holds.
    """
    for override in overrides:
        key = override.lstrip("+~").partition("=")[0]
        if key.partition(".")[0] in _FIXED:
            raise ConfigError(
                f"A resumed run goes on as it was, so {key} cannot change. To start a new run from "
                f"its policy: scilab-rl {override} +restore_policy=RUN/rl_model_finished"
            )
