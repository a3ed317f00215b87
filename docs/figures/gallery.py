"""Film the trained agents of the package: ``make gallery``.

``docs/images/hero.webp`` is an episode of FetchPickAndPlace with its curves;
``docs/images/gallery/`` has a looping card of each agent. Videos and replay pages stay in
data/agents/NAME/episodes/.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from scilab_rl.api.agent import load
from scilab_rl.metrics.probes import Observation
from scilab_rl.recording.movie import CardFrames, MovieFrames
from scilab_rl.recording.records import Clip, load_clip

IMAGES = Path(__file__).parents[1] / "images"
CARDS = IMAGES / "gallery"
MOST_SCENES = 60
FRAME, LAST = 100, 2200  # milliseconds
NEAR, CLOSED = 0.03, 0.06  # metres from gripper to block; between fingers that hold one of 0.05


@dataclass(frozen=True)
class Film:
    """One entry of the gallery.

    Attributes:
        agent: Name of the trained agent.
        seed: Of the episode.
        panel: The curve of its card.
        n_scenes: How many, from the first on.
    """

    agent: str
    seed: int
    panel: str = "q_values"
    n_scenes: int = MOST_SCENES


FILMED = (
    Film("FetchPickAndPlace", 5, n_scenes=26), Film("FetchPush", 13, n_scenes=34),
    Film("FetchSlide", 4, n_scenes=44), Film("Blocks1", 3, n_scenes=26),
    Film("FetchReach", 3, "critic_variance", n_scenes=16), Film("Reach1DOF", 3, n_scenes=16),
    Film("CartPole", 3, "value"), Film("Maze", 3), Film("Parking", 2, n_scenes=30),
)  # fmt: skip
# The robot knocks the block off the table, where it is caught at its base, and goes after it.
HERO = Film("FetchPickAndPlace", 3, n_scenes=50)


def record(film: Film, metrics: Sequence[str]) -> Clip:
    """Let an agent act for an episode and return it, seen from near."""
    with load(f"agent:{film.agent}") as agent:
        agent.cfg = replace(agent.cfg, render_view="close")
        clip = load_clip(agent.record(metrics, seed=film.seed).recording)
    clip.records = clip.records[: film.n_scenes]
    return clip


def mark_grasp(clip: Clip) -> None:
    """Add an event where the grasp begins that ends in success.

    Of Fetch's observation, elements 6 to 8 are the block's place relative to the gripper, 9 and 10
    how far its fingers are open.
    """
    seen = np.array([_vector(record.observation) for record in clip.records])
    holds = (np.linalg.norm(seen[:, 6:9], axis=1) < NEAR) & (seen[:, 9:11].sum(axis=1) < CLOSED)
    solved = next(index for index, record in enumerate(clip.records) if record.success)
    loose = np.flatnonzero(~holds[: solved + 1])
    clip.records[int(loose[-1]) + 1].events.append("grasp")


def make_hero() -> None:
    """Film the hero of README and site."""
    clip = record(HERO, ("q_values", "goal_distance", "reward"))
    mark_grasp(clip)
    save([Image.fromarray(frame) for frame in MovieFrames(clip)], IMAGES / "hero.webp")


def make_card(film: Film) -> None:
    """Film an agent: the scene, and below it one curve."""
    frames = CardFrames(record(film, (film.panel,)), film.panel)
    save([frames[index] for index in range(len(frames))], CARDS / f"{film.agent}.webp")


def save(frames: Sequence[Image.Image], path: Path) -> None:
    """Write frames as a picture that moves, and begins again after a pause."""
    path.parent.mkdir(parents=True, exist_ok=True)
    durations = [FRAME] * (len(frames) - 1) + [LAST]
    frames[0].save(
        path, save_all=True, append_images=list(frames[1:]), duration=durations, loop=0,
        quality=82, method=4,
    )  # fmt: skip


def _vector(observation: Observation) -> np.ndarray:
    return observation["observation"] if isinstance(observation, dict) else observation


def main(names: Sequence[str]) -> int:
    """Make the pictures whose names contain one of the given parts, or all."""
    if not names or "hero" in names:
        make_hero()
    for film in FILMED:
        if not names or any(part in film.agent for part in names):
            make_card(film)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
