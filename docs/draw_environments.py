"""Draw docs/images/environments.png and choices.png: a frame of each task after some random steps.

MyoSuite's frame is drawn by .venv-myosuite, where `make test-myosuite` has made it. CoppeliaSim is
not there: its frames come from the real simulator, and the tests' stand-in draws dots.

MUJOCO_GL=egl python docs/draw_environments.py
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.fingerprint import scripted_action
from scilab_rl.envs.vectorize import make_single_env

IMAGES = Path(__file__).parent / "images"
MYOSUITE_PYTHON = Path(__file__).parents[1] / ".venv-myosuite" / "bin" / "python"
N_STEPS, N_COLUMNS = 8, 5
CAPTION = (
    "Not shown: CoppeliaReach-v0 and CoppeliaDrive-v0, whose frames come from the simulator itself."
)
ENVIRONMENTS = [
    "FetchReach-v4",
    "FetchPush-v4",
    "FetchPickAndPlace-v4",
    "FetchSlide-v4",
    "Reach1DOF-v0",
    "Blocks-o0-gripper_random-v1",
    "Blocks-o2-gripper_above-v1",
    "Blocks-o4-gripper_random-v1",
    "Hook-o2-v1",
    "ButtonUnlock-o2-v1",
    "PointGym-sparse-0.5-small_open_dgr-c1-rt0-s500-v0",
    "PointGym-sparse-0.5-medium_custom_dgr-c1-rt0-s500-v0",
    "PointObjGym-sparse-o4-0.5-small_open_dgr-c1-rt0-s300-v0",
    "AntGym-sparse-10-1.5-small_open_dgr-c1-rt0-s500-v0",
]
CHOICES = [
    "Bandit-drifting-a4-v0",
    "ProbabilisticReversal-v0",
    "TwoStep-v0",
    "Horizon-v0",
    "HiddenGoal-v0",
]
SUITES = {
    "highway_env": ["parking-limited-v0"],
    "metaworld": ["MetaW-drawer-close-v3", "MetaW-pick-place-sparse-v3", "MetaW-reach-v3"],
    "panda_gym": ["PandaReach-v3", "PandaStack-v3"],
    "Box2D": ["LunarLander-v3"],
}
MYOSUITE = ["myoElbowPose1D6MRandom-v0", "myoHandReachRandom-v0"]


def frame_of(env_id: str) -> np.ndarray:
    """Return the frame after some random steps."""
    env = make_single_env(RunConfig(env_id), "rgb_array")
    rng = np.random.default_rng(0)
    env.reset(seed=3)
    for _ in range(N_STEPS):
        env.step(scripted_action(env.action_space, rng))
    frame = np.asarray(env.render())
    env.close()
    return frame


def frame_by_myosuite(env_id: str) -> np.ndarray:
    """Return the frame that another virtual environment draws."""
    with tempfile.NamedTemporaryFile(suffix=".npy") as file:
        subprocess.run([MYOSUITE_PYTHON, __file__, env_id, file.name], check=True)
        return np.load(file.name)


def draw_sheet(frames: dict[str, np.ndarray], target: Path, caption: str = "") -> None:
    """Draw frames in rows, each with its id above it."""
    n_rows = -(-len(frames) // N_COLUMNS)
    figure, axes = plt.subplots(n_rows, N_COLUMNS, figsize=(3 * N_COLUMNS, 3.3 * n_rows))
    for axis in axes.flat:
        axis.axis("off")
    for axis, (env_id, frame) in zip(axes.flat, frames.items(), strict=False):
        axis.imshow(frame)
        axis.set_title(env_id, fontsize=7 if len(env_id) < 40 else 5)
    figure.tight_layout(rect=(0, 0.02, 1, 1))
    figure.text(0.01, 0.006, caption, fontsize=8)
    figure.savefig(target, dpi=80, bbox_inches="tight" if n_rows == 1 else None)


def main() -> None:
    """Draw the sheets, or, with an id and a file, save this one frame."""
    if len(sys.argv) == 3:
        np.save(sys.argv[2], frame_of(sys.argv[1]))
        return
    draw_sheet({env_id: frame_of(env_id) for env_id in CHOICES}, IMAGES / "choices.png")
    installed = [ids for package, ids in SUITES.items() if importlib.util.find_spec(package)]
    env_ids = [*ENVIRONMENTS, *(env_id for ids in installed for env_id in ids)]
    frames = {env_id: frame_of(env_id) for env_id in env_ids}
    if MYOSUITE_PYTHON.exists():
        frames |= {env_id: frame_by_myosuite(env_id) for env_id in MYOSUITE}
    draw_sheet(frames, IMAGES / "environments.png", CAPTION)


if __name__ == "__main__":
    main()
