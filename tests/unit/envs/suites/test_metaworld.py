from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.testing.goal_environments import EnvironmentContract

pytest.importorskip("metaworld")

# One of each kind of row: object, gripper, one axis, two axes.
KINDS = ("drawer-close", "reach", "door-unlock", "pick-place", "sweep-into")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Constant.s. may be too high:UserWarning")  # of the experts
@pytest.mark.parametrize("task", KINDS)
def test_success_is_that_of_metaworld_when_its_expert_acts(task) -> None:
    from metaworld.policies import ENV_POLICY_MAP

    env = gym.make(resolve_env_id(f"MetaW-{task}-sparse")[0])
    expert = ENV_POLICY_MAP[f"{task}-v3"]()
    observation, _ = env.reset(seed=3)
    successes = []
    for _ in range(150):
        action = np.clip(expert.get_action(observation["observation"]), -1, 1)
        observation, reward, _, _, info = env.step(action.astype(np.float32))
        assert info["is_success"] == bool(info["success"]) == (reward == 0.0)
        successes.append(info["is_success"])
    assert any(successes)
    assert not all(successes)


def test_goals_are_drawn_and_observed() -> None:
    env = gym.make(resolve_env_id("MetaW-reach")[0])
    goals = [env.reset(seed=0)[0][36:]] + [env.reset()[0][36:] for _ in range(3)]
    assert len({goal.tobytes() for goal in goals}) == 4
    observation = env.step(np.zeros(4, np.float32))[0]
    assert np.allclose(observation[36:], goals[-1])


class TestGoalTask(EnvironmentContract):
    env = "MetaW-door-unlock-sparse-v3"
    n_steps = 100


class TestOriginal(EnvironmentContract):
    env = "MetaW-drawer-close-v3"
    n_steps = 100
