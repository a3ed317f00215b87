from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.registration import known_env_ids, resolve_env_id
from scilab_rl.testing.goal_environments import EnvironmentContract

pytest.importorskip("metaworld")

from metaworld.env_dict import ALL_V3_ENVIRONMENTS

from scilab_rl.envs.suites.metaworld import GOAL_TASKS, SAME_GOAL, WITHOUT_GOALS

# One of each kind of row: object, gripper, one axis, two axes, site and scale, offset, height.
KINDS = (
    "drawer-close", "reach", "door-unlock", "pick-place", "sweep-into", "peg-insert-side",
    "faucet-open", "basketball",
)  # fmt: skip


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


def test_each_task_is_there_as_it_is_and_with_goals_or_with_a_reason_why_not() -> None:
    known_env_ids()
    tasks = {name.removesuffix("-v3") for name in ALL_V3_ENVIRONMENTS}
    assert len(tasks) == 50
    assert {*GOAL_TASKS} | {*WITHOUT_GOALS} == tasks
    assert len(GOAL_TASKS) == 44
    assert all(f"MetaW-{task}-v3" in gym.registry for task in tasks)
    assert all(f"MetaW-{task}-sparse-v3" in gym.registry for task in GOAL_TASKS)


@pytest.mark.slow
@pytest.mark.parametrize("task", SAME_GOAL)
def test_these_tasks_have_the_same_goal_but_other_places(task) -> None:
    env = gym.make(resolve_env_id(f"MetaW-{task}-sparse")[0])
    firsts = [env.reset(seed=seed)[0] for seed in range(4)]
    assert len({first["desired_goal"].tobytes() for first in firsts}) == 1
    assert len({first["observation"].tobytes() for first in firsts}) == 4
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(name[:-3] for name in ALL_V3_ENVIRONMENTS))
def test_all_tasks_draw_a_new_goal_or_place_at_each_reset(task) -> None:
    env = gym.make(resolve_env_id(f"MetaW-{task}")[0])
    firsts = [env.reset(seed=0)[0]] + [env.reset()[0] for _ in range(3)]
    assert len({first.tobytes() for first in firsts}) == 4
    observation, reward, *_ = env.step(env.action_space.sample())
    assert observation.shape == (39,)
    assert np.isfinite(reward)
    env.close()


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


@pytest.fixture(params=sorted(GOAL_TASKS))
def goal_task(request):
    request.instance.env = f"MetaW-{request.param}-sparse-v3"
    request.instance.accepted = ("new goals",) if request.param in SAME_GOAL else ()


@pytest.mark.slow
@pytest.mark.usefixtures("goal_task")
class TestAllGoalTasks(EnvironmentContract):
    n_steps = 30


@pytest.fixture(params=sorted(name.removesuffix("-v3") for name in ALL_V3_ENVIRONMENTS))
def original(request):
    request.instance.env = f"MetaW-{request.param}-v3"


@pytest.mark.slow
@pytest.mark.usefixtures("original")
class TestAllOriginals(EnvironmentContract):
    n_steps = 30
