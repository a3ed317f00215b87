"""Hook and ButtonUnlock are solved by hand-written movements, so they can be solved."""

from __future__ import annotations

import numpy as np

from scilab_rl.envs.button_unlock import ButtonUnlock
from scilab_rl.envs.hook import Hook


def drive(env: ButtonUnlock, place: np.ndarray, n_steps: int = 15) -> dict:
    """Move to a place in a straight line, as far as one gets."""
    for _ in range(n_steps):
        action = np.clip((place - env.achieved_goal()) / 0.05, -1, 1)
        info = env.step(action)[-1]
    return info


def test_glass_keeps_out_until_all_buttons_are_pressed() -> None:
    env = ButtonUnlock(n_buttons=2)
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        assert observation["observation"][-2:].tolist() == [0, 0]
        blue = env.data.mocap_pos[env._buttons[:-1], :2].copy()
        assert drive(env, env.goal, 25) == {"is_success": False}
        for index in (1, 0):  # any order
            drive(env, env.start[:2])
            assert not env.pressed[0]
            assert drive(env, env.goal) == {"is_success": False}
            drive(env, env.start[:2])
            drive(env, blue[index])
        assert env.pressed.all()
        drive(env, env.start[:2])
        assert drive(env, env.goal) == {"is_success": True}
        assert env._observation()["observation"][-2:].tolist() == [1, 1]


def test_without_blue_buttons_there_is_no_glass() -> None:
    env = ButtonUnlock(n_buttons=0)
    env.reset(seed=0)
    assert drive(env, env.goal) == {"is_success": True}


def test_hook_pulls_a_block_from_beyond_the_arms_reach() -> None:
    env = Hook(n_blocks=1)
    env.far_share = 1.0
    env.reset(seed=3)

    def move(place, grip: float, n_steps: int = 60) -> None:
        for _ in range(n_steps):
            way = np.array(place) - env.gripper_position()
            if np.linalg.norm(way) < 0.01:
                break
            env.step(np.array([*np.clip(way / 0.05, -1, 1), grip]))

    handle = env.data.xpos[env._hook] - (0.1, 0, 0)
    block = env.achieved_goal()
    assert block[0] > 1.7
    move((handle[0], handle[1], 0.5), 0.5)
    move((handle[0], handle[1], 0.415), 0.5)
    for _ in range(5):
        env.step(np.array([0.0, 0.0, 0.0, -1.0]))
    move((handle[0], handle[1], 0.47), -1.0)
    behind = (block[0] - 0.24, block[1] + 0.08)
    move((*behind, 0.48), -1.0)
    move((*behind, 0.42), -1.0, 20)
    move((behind[0] - 0.4, behind[1], 0.42), -1.0)
    assert env.achieved_goal()[0] < 1.5  # the arm alone can take it from here
    assert abs(env.achieved_goal()[2] - 0.425) < 0.02
