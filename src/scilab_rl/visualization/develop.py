"""From recorded episodes to what people look at: video, page and viewer recording.

Runs as a process of its own, ``python -m scilab_rl.visualization.develop FILE.npz``, at low
priority, so that training never waits for it and cannot be hurt by it.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from scilab_rl.visualization.archive import load_clip
from scilab_rl.visualization.movie import write_movie
from scilab_rl.visualization.records import Clip
from scilab_rl.visualization.replay import write_replay
from scilab_rl.visualization.viewer_stream import write_viewer_file

_WRITERS: dict[str, Callable[[Clip, Path], None]] = {
    ".html": write_replay,
    ".mp4": write_movie,
    ".rrd": write_viewer_file,
}
_POLITE = 10
_PATIENCE = 600  # seconds


def develop(recording: Path) -> list[Path]:
    """Make video, page and viewer recording of an episode in a process of its own, and wait for it.

    Args:
        recording: The ``.npz`` file; the others get its name.

    Returns:
        The files that now exist.

    Raises:
        RuntimeError: If one of them could not be written, with the reason in one line.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, str(recording)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=_PATIENCE,
            start_new_session=True,  # Ctrl-C ends the training, the last episode is still written
        )
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"video and page were not ready after {_PATIENCE} s") from error
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise RuntimeError(lines[-1])
    return developed_files(recording)


def developed_files(recording: Path) -> list[Path]:
    """Return the files that were made of a recording."""
    return [path for suffix in _WRITERS if (path := recording.with_suffix(suffix)).is_file()]


def main(arguments: Sequence[str]) -> int:
    """Make the files of some recordings and return 1 if any is missing."""
    if hasattr(os, "nice"):
        os.nice(_POLITE)
    failures = []
    for name in arguments:
        recording = Path(name)
        clip = load_clip(recording)
        for suffix, write in _WRITERS.items():
            if suffix == ".rrd" and importlib.util.find_spec("rerun") is None:
                continue  # the viewer is optional
            path = recording.with_suffix(suffix)
            try:
                write(clip, path)
            except Exception as error:  # noqa: BLE001 - the other files can still be made
                path.unlink(missing_ok=True)  # a part of it would look like the whole
                failures.append(f"{suffix} could not be written: {error}")
    sys.stderr.write("; ".join(" ".join(failure.split()) for failure in failures))
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
