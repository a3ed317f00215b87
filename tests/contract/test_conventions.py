"""All our environments pass the checkers of Gymnasium and of Stable-Baselines3."""

from __future__ import annotations

import gymnasium
import pytest
from gymnasium.utils import env_checker
from stable_baselines3.common import env_checker as sb3_checker

from scilab_rl.envs.ids import FAMILIES
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError
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


MAZES = (
    "PointGym-sparse-0.5-small_open_dgr-c1-rt0-s500-v0",
    "PointObjGym-sparseneg-o4-0.5-open_dgr-c1-rt1-s300-v0",
    "AntGym-dense-10-1.5-small_open_dg-c0-rt0-s700-v0",
)


@pytest.mark.parametrize("env_id", MAZES)
@pytest.mark.parametrize("prefix", ["", "scilab_rl:"])
def test_long_ids_are_those_of_the_command_line(env_id: str, prefix: str) -> None:
    gymnasium.registry.pop(env_id, None)
    made = gymnasium.make(f"{prefix}{env_id}")
    gymnasium.registry.pop(env_id)
    assert resolve_env_id(env_id)[0] == env_id
    assert made.spec.kwargs == gymnasium.spec(env_id).kwargs
    assert made.spec.max_episode_steps == gymnasium.spec(env_id).max_episode_steps
    assert made.unwrapped.reward_type == env_id.split("-")[1]
    made.close()


def test_vectors_of_long_ids() -> None:
    gymnasium.registry.pop(MAZES[0], None)
    envs = gymnasium.make_vec(MAZES[0], num_envs=2)
    assert envs.reset(seed=3)[0]["desired_goal"].shape == (2, 2)
    assert [env.unwrapped.threshold for env in envs.envs] == [0.5, 0.5]
    envs.close()


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec, resolve_env_id])
@pytest.mark.parametrize(
    ("right", "wrong"),
    [("small_open_dgr", "smal_open_dgr"), ("sparse", "spars"), ("PointGym", "PointGm")],
)
def test_wrong_long_ids_are_put_right(make, right: str, wrong: str) -> None:
    with pytest.raises(ConfigError, match=f"Did you mean '{MAZES[0]}'") as caught:
        make(MAZES[0].replace(right, wrong))
    assert "\n" not in str(caught.value)


def test_ids_of_others_stay_theirs() -> None:
    """Also those that begin as a long id of ours, and those that nobody knows."""
    gymnasium.register("Bandit-of-somebody-v0", gymnasium.spec("TinyBox-v0").entry_point)
    try:
        gymnasium.make("Bandit-of-somebody-v0").close()
    finally:
        del gymnasium.registry["Bandit-of-somebody-v0"]
    with pytest.raises(gymnasium.error.NameNotFound, match="CartPol"):
        gymnasium.make("CartPol-v1")
