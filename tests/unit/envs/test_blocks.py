from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.blocks import BLOCK_SIZE, Blocks
from scilab_rl.envs.mujoco_goal import euler_angles
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError


@pytest.mark.parametrize(
    ("given", "env_id", "limit", "arguments"),
    [
        ("Blocks-o0-gripper_random-v1", None, 50, (0, "random")),
        ("Blocks-o3-gripper_above-v0", "Blocks-o3-gripper_above-v1", 150, (3, "above")),
        ("Blocks-o1-gripper_none", "Blocks-o1-gripper_none-v1", 50, (1, "none")),
    ],
)
def test_long_ids_are_read(given, env_id, limit, arguments) -> None:
    found, notice = resolve_env_id(given)
    assert found == (env_id or given)
    assert notice.startswith(f"{found} is Blocks-v1 with n_blocks={arguments[0]}")
    env = gym.make(found)
    assert env.spec.max_episode_steps == limit
    assert (env.unwrapped.n_blocks, env.unwrapped.gripper_goal) == arguments


@pytest.mark.parametrize("wrong", ["Blocks-o5-gripper_none-v1", "Blocks-o0-gripper_above-v1"])
def test_wrong_long_ids_show_the_grammar(wrong) -> None:
    with pytest.raises(ConfigError, match=r"o\{0..4\}-gripper_"):
        resolve_env_id(wrong)


def test_no_blocks_have_no_other_gripper_goal() -> None:
    with pytest.raises(ConfigError, match="gripper_goal must be one of random"):
        Blocks(n_blocks=0, gripper_goal="above")


def test_goal_is_a_tower_with_the_gripper_on_top() -> None:
    env = Blocks(n_blocks=3, gripper_goal="above")
    observation, _ = env.reset(seed=1)
    parts = observation["desired_goal"].reshape(4, 3)
    assert np.ptp(parts[:, :2], axis=0).max() == 0.0
    heights = [0.575, 0.425, 0.475, 0.525]  # gripper, then blocks from the table at 0.4
    assert np.allclose(parts[:, 2], heights, atol=1e-6)


def test_blocks_start_apart_on_the_table_and_stay_there() -> None:
    env = Blocks(n_blocks=4)
    for seed in range(20):
        blocks = env.reset(seed=seed)[0]["achieved_goal"].reshape(4, 3)
        apart = [np.linalg.norm(a - b) for i, a in enumerate(blocks) for b in blocks[:i]]
        assert min(apart) > BLOCK_SIZE * np.sqrt(2)
        observation, *_ = env.step(np.zeros(4))
        moved = observation["achieved_goal"].reshape(4, 3) - blocks
        assert np.abs(moved).max() < 2e-3


def test_the_worst_part_decides() -> None:
    env = Blocks(n_blocks=2)
    achieved = np.zeros((2, 6))
    desired = np.array([[0.04, 0, 0, 0, 0.04, 0], [0, 0, 0, 0, 0, 0.06]])
    assert np.allclose(env.distance(achieved, desired), [0.04, 0.06])
    assert env.compute_reward(achieved, desired, {}).tolist() == [0.0, -1.0]


def test_gripper_moves_by_the_action() -> None:
    env = Blocks(n_blocks=0, gripper_goal="random")
    env.reset(seed=0)
    before = env.gripper_position()
    for _ in range(4):
        env.step(np.array([0.0, 1.0, 0.0, 0.0]))
    moved = env.gripper_position() - before
    assert 0.1 < moved[1] < 0.2
    assert np.abs(moved[[0, 2]]).max() < 0.01


def test_rendering_does_not_change_the_episode(monkeypatch) -> None:
    from scilab_rl.errors import RenderingError
    from scilab_rl.recording.gl import choose_backend

    try:
        choose_backend()
    except RenderingError as error:
        pytest.skip(str(error))
    watched, unwatched = Blocks(render_mode="rgb_array"), Blocks()
    watched.reset(seed=2), unwatched.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 4)
        frame = watched.render()
        first, second = watched.step(action)[0], unwatched.step(action)[0]
        assert all(np.array_equal(first[key], second[key]) for key in first)
    assert frame.shape == (480, 480, 3)
    assert frame.std() > 10
    watched.close()


def test_euler_angles_of_quarter_turns() -> None:
    about_x = np.array([1, 0, 0, 0, 0, -1, 0, 1, 0])
    about_z = np.array([0, -1, 0, 1, 0, 0, 0, 0, 1])
    expected = [[np.pi / 2, 0, 0], [0, 0, np.pi / 2]]
    assert np.allclose(euler_angles(np.array([about_x, about_z])), expected)
