"""``scilab-rl clean``: show, and with ``--yes`` remove, what killed processes have left behind."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.runs import CRASHED, DAMAGED, read_run
from scilab_rl.commands.tables import print_rows
from scilab_rl.errors import ConfigError
from scilab_rl.results import LOCK_FILE, RunDirectory

_log = logging.getLogger(__name__)
_COLUMNS = ("what", "size", "path")
# A run in which nothing was measured and from which nothing can be continued.
_WORTH_KEEPING = ("checkpoints", "rl_model_best", "rl_model_finished")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "clean", "Show what killed processes have left behind; remove it only with --yes."
    )
    parser.add_argument("--base-logdir", type=Path, default=Path("data"), help="default: data")
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
        [{"what": what, "size": _size(path), "path": str(path)} for path, what in found.items()],
    )
    if not options.yes:
        _log.info("Nothing has been removed. To remove these: scilab-rl clean --yes")
        return 0
    for path in found:
        _remove(path)
    _log.info("Removed.")
    return 0


def leftovers(base: Path) -> Iterator[tuple[Path, str]]:
    """Yield what may go, and what it is: temporary files and runs that never measured anything.

    Runs that some process works on are left alone, with all that is in them.

    Args:
        base: The folder of all runs.
    """
    for path in sorted(base.glob(f"*/*/{LOCK_FILE}")):
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
