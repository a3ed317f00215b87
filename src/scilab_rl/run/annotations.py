"""A note and tags that a person gives a run later, in a small file of the run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from scilab_rl import files
from scilab_rl.run.directory import RunDirectory

ANNOTATIONS_FILE = "annotations.json"


@dataclass(frozen=True)
class Annotations:
    """What a person has written to a run.

    Attributes:
        note: Any text, on one line.
        tags: Words by which runs are found again, in the order in which they were given.
    """

    note: str = ""
    tags: tuple[str, ...] = ()


def read_annotations(run: RunDirectory) -> Annotations:
    """Return what is written to a run; nothing where the file is missing or damaged."""
    try:
        stored = json.loads((run / ANNOTATIONS_FILE).read_text(encoding="utf-8"))
        return Annotations(str(stored["note"]), tuple(map(str, stored["tags"])))
    except (OSError, ValueError, TypeError, KeyError):
        return Annotations()


def write_annotations(run: RunDirectory, note: str, tags: Sequence[str]) -> None:
    """Replace what is written to a run; the file is removed when there is nothing left.

    Args:
        run: A run, not an agent.
        note: The note; line ends become spaces.
        tags: The tags; repetitions are dropped.
    """
    note = " ".join(note.split())
    if note or tags:
        stored = {"note": note, "tags": list(dict.fromkeys(tags))}
        files.write_json(run / ANNOTATIONS_FILE, stored)
    else:
        (run / ANNOTATIONS_FILE).unlink(missing_ok=True)
