"""Draw docs/images/environments.png: one frame of each environment, after some random steps.

MUJOCO_GL=egl python docs/draw_environments.py
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from scilab_rl.envs.fingerprint import scripted_action
from scilab_rl.envs.vectorize import EnvSettings, make_single_env

TARGET = Path(__file__).parent / "images" / "environments.png"
N_STEPS, N_COLUMNS = 8, 5
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
SUITES = {
    "highway_env": ["parking-limited-v0"],
    "metaworld": ["MetaW-drawer-close-v3", "MetaW-pick-place-sparse-v3", "MetaW-reach-v3"],
    "panda_gym": ["PandaReach-v3"],
}


def frame_of(env_id: str) -> np.ndarray:
    """Return the frame after some random steps."""
    env = make_single_env(EnvSettings(env_id, render_mode="rgb_array"))
    rng = np.random.default_rng(0)
    env.reset(seed=3)
    for _ in range(N_STEPS):
        env.step(scripted_action(env.action_space, rng))
    frame = np.asarray(env.render())
    env.close()
    return frame


def main() -> None:
    """Draw the sheet."""
    installed = [ids for package, ids in SUITES.items() if importlib.util.find_spec(package)]
    env_ids = [*ENVIRONMENTS, *(env_id for ids in installed for env_id in ids)]
    n_rows = -(-len(env_ids) // N_COLUMNS)
    figure, axes = plt.subplots(n_rows, N_COLUMNS, figsize=(3 * N_COLUMNS, 3.3 * n_rows))
    for axis in axes.flat:
        axis.axis("off")
    for axis, env_id in zip(axes.flat, env_ids, strict=False):
        axis.imshow(frame_of(env_id))
        axis.set_title(env_id, fontsize=7 if len(env_id) < 40 else 5)
    figure.tight_layout()
    figure.savefig(TARGET, dpi=80)


if __name__ == "__main__":
    main()
