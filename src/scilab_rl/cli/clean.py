"""``scilab-rl clean``: list, and with ``--yes`` remove, what killed processes left behind."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_rows
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import CONFIG_FILE, LOCK_FILE, RunDirectory
from scilab_rl.run.facts import CRASHED, DAMAGED, read_run

_log = logging.getLogger(__name__)
_COLUMNS = ("kind", "size", "path")
# A run with one of these can be continued or played.
_WORTH_KEEPING = ("checkpoints", "rl_model_best", "rl_model_finished")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "clean", "List what killed processes left behind; remove it only with --yes.", base=True
    )
    parser.add_argument("--yes", action="store_true", help="remove what is listed")
    parser.add_argument("--dry-run", action="store_true", help="only list it (the default)")
    options = parser.parse_args(arguments)
    if options.yes and options.dry_run:
        raise ConfigError("Give either --yes or --dry-run.")
    found = dict(leftovers(options.base_logdir))
    if not found:
        _log.info("Nothing to clean in '%s'.", options.base_logdir)
        return 0
    print_rows(
        _COLUMNS,
        [{"kind": kind, "size": _size(path), "path": str(path)} for path, kind in found.items()],
    )
    if not options.yes:
        _log.info("Nothing has been removed. To remove these: scilab-rl clean --yes")
        return 0
    for path in found:
        _remove(path)
    _log.info("Removed.")
    return 0


def leftovers(base: Path) -> Iterator[tuple[Path, str]]:
    """Yield temporary files and runs without any result, each with its kind.

    Runs that are in use are skipped.

    Args:
        base: The folder of all runs.
    """
    for path in sorted(base.glob(f"*/.*.tmp/{CONFIG_FILE}")):
        yield path.parent, "half removed run"
    for path in sorted(base.glob(f"*/[!.]*/{LOCK_FILE}")):
        run = RunDirectory(path.parent)
        if path.parent.is_symlink() or path.parent.parent.is_symlink() or run.is_in_use():
            continue
        if _is_worthless(run):
            yield run.path, "run without any result"
            continue
        for temporary in sorted(run.path.rglob(".*.tmp")):
            yield temporary, "unfinished file"


def _is_worthless(run: RunDirectory) -> bool:
    if any((run / name).exists() for name in _WORTH_KEEPING):
        return False
    record = read_run(run)
    return record["status"] in (CRASHED, DAMAGED) and not record["epochs"]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _size(path: Path) -> str:
    files = path.rglob("*") if path.is_dir() else [path]
    n_bytes = sum(file.lstat().st_size for file in files if not file.is_dir())
    return f"{n_bytes / 2**20:.1f} MiB"
