"""``scilab-rl resume RUN [KEY=VALUE ...]``: continue a run from its newest checkpoint."""

from __future__ import annotations

from collections.abc import Sequence

from scilab_rl.cli.parser import CommandParser
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import CONFIG_FILE, find_run

# A checkpoint depends on these keys; the others may change when a run resumes.
_FIXED = ("algorithm", "env", "env_kwargs", "wrappers", "n_envs", "seed", "restore_policy")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "resume", "Continue a run exactly from its newest checkpoint.", run=True, base=True
    )
    parser.add_argument("overrides", nargs="*", help="changes, for example n_epochs=100")
    options = parser.parse_args(arguments)
    refuse_fixed_keys(options.overrides)

    from scilab_rl.run.run import resume_run

    open_project()
    directory = find_run(options.run, options.base_logdir)
    directory.refuse_agent()
    cfg = load_recorded(directory / CONFIG_FILE, options.overrides)
    return resume_run(cfg, directory).exit_code


def refuse_fixed_keys(overrides: Sequence[str]) -> None:
    """Reject changes of keys on which the checkpoint depends.

    Raises:
        ConfigError: If there is one.
    """
    for override in overrides:
        key = override.lstrip("+~").partition("=")[0]
        if key.partition(".")[0] in _FIXED:
            raise ConfigError(
                f"{key} cannot change when a run resumes. To start a new run from "
                f"its policy: scilab-rl {override} +restore_policy=RUN/rl_model_finished"
            )
