"""Film every family of environments and of algorithms: ``make gallery``.

Replay pages and videos go to data/gallery/, a picture of each to docs/images/gallery/. Environments
are shown with random actions; algorithms after a training of a minute, which is not their best.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from scilab_rl.cli.main import run_command_line
from scilab_rl.recording.movie import MovieFrames
from scilab_rl.recording.records import load_clip

FILMS = Path("data/gallery")
PICTURES = Path(__file__).parents[1] / "images" / "gallery"
WIDTH = 720  # pixels of a picture
RANDOM = ("algorithm=random", "n_epochs=1", "eval_after_n_steps=20", "n_test_rollouts=1")
TRAINED = ("n_test_rollouts=3", "early_stop_threshold=2", "seed=1")
GOALS = "goal_distance,reward,action"
NO_GOALS = "reward,return_so_far,action"


@dataclass(frozen=True)
class Film:
    """One entry of the gallery.

    Attributes:
        name: Of its files.
        words: What is trained, and where.
        metrics: What is drawn beside it.
        frames: Scenes of the clip; 0 means an episode.
    """

    name: str
    words: tuple[str, ...]
    metrics: str
    frames: int = 0


def by_chance(name: str, env: str, metrics: str = GOALS) -> Film:
    """Return the film of an environment with random actions."""
    return Film(f"env_{name}", (*RANDOM, f"env={env}"), metrics, frames=40)


def trained(name: str, env: str, metrics: str, *words: str) -> Film:
    """Return the film of an algorithm after a short training."""
    return Film(f"algorithm_{name}", (*TRAINED, f"algorithm={name}", f"env={env}", *words), metrics)


SHORT = (
    "n_epochs=2", "eval_after_n_steps=250", "tuned=false", "algorithm.learning_rate=1e-3",
    "algorithm.gamma=0.95", "algorithm.batch_size=64",
)  # fmt: skip
SMALL = (*SHORT, "algorithm.net_arch=[64,64]")
SMALL_SB3 = (*SHORT, "algorithm.policy_kwargs.net_arch=[64,64]")
REACH = "Reach1DOF-v0"
Q = "q_values,critic_variance,goal_distance,reward"
FILMED = (
    by_chance("fetch", "FetchPickAndPlace-v4"),
    by_chance("reach1dof", REACH),
    by_chance("blocks", "Blocks-o2-gripper_above-v1"),
    by_chance("hook", "Hook-o2-v1"),
    by_chance("button_unlock", "ButtonUnlock-o2-v1"),
    by_chance("point", "PointGym-sparse-0.5-medium_custom_dgr-c1-rt0-s500-v0"),
    by_chance("point_objects", "PointObjGym-sparse-o4-0.5-small_open_dgr-c1-rt0-s300-v0"),
    by_chance("ant", "AntGym-sparse-10-1.5-small_open_dgr-c1-rt0-s500-v0", "goal_distance,reward"),
    by_chance("hand", "HandReach-v3", "goal_distance,reward"),
    by_chance("parking", "parking-limited-v0"),
    by_chance("metaworld", "MetaW-drawer-close-v3", NO_GOALS),
    by_chance("walkers", "HalfCheetah-v5", NO_GOALS),
    by_chance("box2d", "LunarLander-v3", NO_GOALS),
    by_chance("classic", "CartPole-v1", NO_GOALS),
    trained("sac", REACH, Q, *SMALL_SB3),
    trained("td3", REACH, Q, *SMALL_SB3),
    trained("cleansac", REACH, Q, *SMALL),
    trained("jaxsac", REACH, Q, *SMALL),
    trained("sac_var", REACH, Q, *SMALL),
    trained("cleansacmc", REACH, "q_value,intrinsic_reward,goal_distance", *SMALL),
    trained("actor_critic", REACH, "q_value,goal_distance,reward", *SHORT),
    trained("dqn", "CartPole-v1", "q_value,td_error,action", "n_epochs=2",
            "eval_after_n_steps=2000"),
    trained("cleanppo", "CartPole-v1", "value,entropy,action", "n_epochs=2",
            "eval_after_n_steps=4000", "n_envs=4", "algorithm.n_steps=128"),
)  # fmt: skip


def make(film: Film) -> None:
    """Train, film, and keep the picture of the middle of the last clip.

    Raises:
        RuntimeError: If the run has failed.
    """
    words = (
        *film.words, "mlflow=0", f"base_logdir={FILMS / 'runs'}", "render=record", "render_freq=1",
        "render_metrics_train=[]", f"render_metrics_test=[{film.metrics}]",
        f"render_frames_per_clip={film.frames}",
    )  # fmt: skip
    if run_command_line(list(words)):
        raise RuntimeError(f"{film.name} could not be filmed")
    episodes = FILMS / "runs" / "last" / "episodes"
    recordings = [p for p in episodes.glob("*.npz") if load_clip(p).info.phase == "eval"]
    recording = max(recordings, key=lambda path: path.stat().st_mtime)
    for suffix in (".html", ".mp4"):
        shutil.copy(recording.with_suffix(suffix), FILMS / f"{film.name}{suffix}")
    frames = MovieFrames(load_clip(recording))
    picture = Image.fromarray(np.asarray(frames[int(0.6 * len(frames))]))
    height = round(picture.height * WIDTH / picture.width)
    PICTURES.mkdir(parents=True, exist_ok=True)
    picture = picture.resize((WIDTH, height), Image.Resampling.LANCZOS).quantize(128)
    picture.save(PICTURES / f"{film.name}.png", optimize=True)


def main(names: list[str]) -> int:
    """Make the films whose names contain one of the given parts, or all; return the exit code."""
    failed = 0
    for film in FILMED:
        if names and not any(part in film.name for part in names):
            continue
        try:
            make(film)
        except (RuntimeError, OSError, ValueError) as error:
            sys.stderr.write(f"{film.name}: {error}\n")
            failed += 1
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
