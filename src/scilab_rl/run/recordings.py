"""The recorded episodes of a run, by number or name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.recording.records import FOLDER, SUFFIX
from scilab_rl.run.directory import RunDirectory


def has_recordings(run: RunDirectory) -> bool:
    """Return whether any episode of a run has been recorded."""
    return any(True for _ in _paths(run))


def recordings_of(run: RunDirectory) -> list[Path]:
    """Return the recorded episodes of a run, oldest first.

    Raises:
        ConfigError: If there are none.
    """
    recordings = sorted(_paths(run), key=lambda path: path.stat().st_mtime)
    if not recordings:
        raise ConfigError(
            f"The run '{run}' has recorded no episode. Train with render=record, or record its "
            f"policy with: scilab-rl play {run} --record"
        )
    return recordings


def chosen_recordings(run: RunDirectory, wanted: str) -> list[Path]:
    """Return the episode with this number (from 1) or name; ``last``; or ``all`` but probed ones.

    Raises:
        ConfigError: If there is no such episode.
    """
    recordings = recordings_of(run)
    if wanted == "all":
        return [path for path in recordings if not path.stem.endswith("_probe")]
    if wanted == "last":
        return recordings[-1:]
    if wanted.isdigit() and 1 <= int(wanted) <= len(recordings):
        return [recordings[int(wanted) - 1]]
    named = [path for path in recordings if path.stem == wanted]
    if named:
        return named
    raise ConfigError(
        f"There is no episode '{wanted}'."
        f"{did_you_mean(wanted, [path.stem for path in recordings])} There are 1 to "
        f"{len(recordings)}; `scilab-rl view {run.path.name} --list` names them."
    )


def _paths(run: RunDirectory) -> Iterator[Path]:
    return (run.outputs / FOLDER).glob(f"*{SUFFIX}")
