"""All our environments pass the checkers of Gymnasium and of Stable-Baselines3."""

from __future__ import annotations

import gymnasium
import pytest
from gymnasium.utils import env_checker
from stable_baselines3.common import env_checker as sb3_checker

from scilab_rl.envs.ids import FAMILIES
from scilab_rl.testing.environments import TINY_ENVIRONMENTS, register

register()
# CoppeliaSim needs the real simulator. TinyPixels counts its episodes, whatever the seed.
ELSEWHERE = ("CoppeliaReach-v0", "CoppeliaDrive-v0", "TinyPixels-v0")
VARIANTS = [f"{name}-{family.version}" for family in FAMILIES for name in family.variants]
OURS = [
    i for i in (*(family.env_id for family in FAMILIES), *TINY_ENVIRONMENTS) if i not in ELSEWHERE
]


@pytest.mark.filterwarnings("ignore:.*Box observation space m.*:UserWarning")
@pytest.mark.parametrize("env_id", OURS)
def test_checkers(env_id: str) -> None:
    # Windows are not opened here; pictures are tested in tests/unit/envs.
    env_checker.check_env(gymnasium.make(env_id).unwrapped, skip_render_check=True)
    sb3_checker.check_env(gymnasium.make(env_id).unwrapped, skip_render_check=True)


def test_variants_are_registered() -> None:
    assert len(VARIANTS) == 13 + 3 + 3
    for env_id in VARIANTS:
        spec = gymnasium.spec(env_id)
        assert isinstance(spec.entry_point, str), "nothing is imported before it is used"
    assert gymnasium.spec("Blocks-o2-gripper_above-v1").kwargs == {
        "n_blocks": 2, "gripper_goal": "above",
    }  # fmt: skip
    assert gymnasium.spec("Blocks-o2-gripper_above-v1").max_episode_steps == 100


def test_vectors() -> None:
    envs = gymnasium.make_vec("scilab_rl:Blocks-o1-gripper_none-v1", num_envs=2)
    observations, _ = envs.reset(seed=3)
    assert observations["desired_goal"].shape[0] == 2
    assert envs.step(envs.action_space.sample())[1].shape == (2,)
    envs.close()
