"""``scilab-rl note RUN [TEXT]``: write a note to a run, or show it."""

from __future__ import annotations

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import write
from scilab_rl.run.annotations import read_annotations, write_annotations
from scilab_rl.run.directory import find_run


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "note", "Write a note to a run; `scilab-rl runs` shows it.", run=True, base=True
    )
    parser.add_argument(
        "text", nargs="*", help="the note, which replaces the last one; '' removes it; none: show"
    )
    options = parser.parse_args(arguments)
    run = find_run(options.run, options.base_logdir)
    run.refuse_agent()
    written = read_annotations(run)
    if options.text:
        write_annotations(run, " ".join(options.text), written.tags)
    else:
        write(written.note)
    return 0
