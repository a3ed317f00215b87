"""``scilab-rl tag RUN [TAG ...]``: give a run tags, or take them away."""

from __future__ import annotations

import re
from collections.abc import Sequence

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import write
from scilab_rl.errors import ConfigError
from scilab_rl.run.annotations import read_annotations, write_annotations
from scilab_rl.run.directory import find_run

_ALLOWED = re.compile(r"[^\s,*?\[\]=-][^\s,*?\[\]=]*")  # what `compare TAG` and lists can take


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "tag", "Give a run tags: `runs --tag TAG` and `compare TAG` find it.", run=True, base=True
    )
    parser.add_argument("tags", nargs="*", metavar="TAG", help="words to add; none: show them")
    parser.add_argument("--remove", nargs="+", default=[], metavar="TAG", help="tags to take away")
    options = parser.parse_args(arguments)
    run = find_run(options.run, options.base_logdir)
    run.refuse_agent()
    written = read_annotations(run)
    _check(options.tags, options.remove, written.tags)
    if options.tags or options.remove:
        kept = [tag for tag in written.tags if tag not in options.remove]
        write_annotations(run, written.note, [*kept, *options.tags])
    else:
        write(" ".join(written.tags))
    return 0


def _check(new: Sequence[str], removed: Sequence[str], present: Sequence[str]) -> None:
    """Reject tags that are not words, and the removal of tags that are not there.

    Raises:
        ConfigError: If there is one.
    """
    for tag in new:
        if not _ALLOWED.fullmatch(tag):
            raise ConfigError(
                f"A tag is one word without , * ? [ ] = and not beginning with -, not '{tag}'."
            )
    for tag in removed:
        if tag not in present:
            raise ConfigError(
                f"The run has no tag '{tag}' to remove. It has: {', '.join(present) or 'none'}."
            )
