"""One clip of what a run has learned: its first, a middle and its last episode side by side.

The first two are of evaluations during training (``render=record``), the last one of the trained
policy, filmed by ``scilab-rl play RUN --record``.

Run: make demo, or python scripts/learning_clip.py RUN [--metric goal_distance]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from scilab_rl.files import shown
from scilab_rl.recording.movie import write_side_by_side
from scilab_rl.recording.records import FOLDER, Clip, load_clip
from scilab_rl.run.directory import find_run


def main() -> int:
    """Write ``episodes/learning.mp4`` of a run and print its path; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="last, or the path of a run")
    parser.add_argument("--metric", default="goal_distance", help="the curve below each scene")
    options = parser.parse_args()
    folder = find_run(options.run, Path("data")) / FOLDER
    paths = sorted(folder.glob("eval_*.npz"))
    played = sorted(folder.glob("play_*.npz"))
    later = paths[1:]
    chosen = [*paths[:1], *later[(len(later) - 1) // 2 :][:1], *played[-1:]]
    if not chosen:
        sys.stderr.write(f"There is no recorded episode in {folder}.\n")
        return 1
    clips = [load_clip(path) for path in chosen]
    path = folder / "learning.mp4"
    write_side_by_side(clips, [title_of(clip) for clip in clips], options.metric, path)
    sys.stdout.write(f"before, during and after learning: {shown(path)}\n")
    return 0


def title_of(clip: Clip) -> str:
    """Return when the policy of a clip acts."""
    when = clip.info.policy.removeprefix("finished, ").removeprefix("best, ")
    return when or clip.info.name


if __name__ == "__main__":
    sys.exit(main())
