"""``scilab-rl resume RUN [KEY=VALUE ...]``: continue a run from its newest checkpoint.

``n_epochs=+5`` lets a finished run train on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from scilab_rl.cli.parser import CommandParser
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError
from scilab_rl.results import SOLVED
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, find_run

# A checkpoint depends on these keys; the others may change when a run resumes.
_FIXED = ("algorithm", "env", "env_kwargs", "wrappers", "n_envs", "seed", "restore_policy")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "resume", "Continue a run exactly from its newest checkpoint.", run=True, base=True
    )
    parser.add_argument(
        "overrides", nargs="*", help="changes, for example n_epochs=100, or n_epochs=+5: five more"
    )
    options = parser.parse_args(arguments)
    refuse_fixed_keys(options.overrides)

    from scilab_rl.run.run import resume_run

    open_project()
    directory = find_run(options.run, options.base_logdir)
    directory.refuse_agent()
    overrides = with_total_epochs(options.overrides, directory)
    cfg = load_recorded(directory / CONFIG_FILE, overrides)
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


def with_total_epochs(overrides: Sequence[str], run: RunDirectory) -> list[str]:
    """Replace ``n_epochs=+5`` by the number of all epochs.

    Args:
        overrides: What the user typed.
        run: The run, whose epochs are counted from its planned end, or from where it was solved.

    Raises:
        ConfigError: If the run would end at once, because it was solved and still is.
    """
    result = run.read_result()
    is_solved = result is not None and result.status == SOLVED
    keys = [override.lstrip("+").partition("=")[0] for override in overrides]
    if is_solved and not any(key.startswith("early_stop_") for key in keys):
        raise ConfigError(
            f"The run ended as solved, and would again after its next epoch. To train on: "
            f"scilab-rl resume {run} n_epochs=+5 early_stop_threshold=2 (or another threshold)"
        )
    done = result.epochs if is_solved and result else run.read_config().get("n_epochs", 0)
    return [_with_total(override, done) for override in overrides]


def _with_total(override: str, done: int) -> str:
    more = re.fullmatch(r"(\+*n_epochs=)\+(\d+)", override)
    return f"{more[1]}{done + int(more[2])}" if more else override
