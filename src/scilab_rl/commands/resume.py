"""``scilab-rl resume RUN [KEY=VALUE ...]``: continue a run from its newest checkpoint."""

from __future__ import annotations

import argparse
from pathlib import Path

from scilab_rl.config import load_recorded
from scilab_rl.results import CONFIG_FILE, find_run
from scilab_rl.workspace import open_desk


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="scilab-rl resume",
        description="Continue a run exactly where its newest checkpoint was made.",
    )
    parser.add_argument("run", help="'last', the path of a run, or a part of its name")
    parser.add_argument("overrides", nargs="*", help="changes, for example n_epochs=100")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"))
    options = parser.parse_args(arguments)

    from scilab_rl import experiment

    open_desk()
    directory = find_run(options.run, options.base_logdir)
    cfg = load_recorded(directory / CONFIG_FILE, options.overrides)
    return experiment.resume(cfg, directory).exit_code
