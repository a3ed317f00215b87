"""Relay hindsight: what is relabeled, flagged and paid, by hand."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.errors import ConfigError
from scilab_rl.learning.relay import Relay, make_relay
from scilab_rl.learning.replay import HindsightReplayBuffer
from scilab_rl.testing.algorithms import AlgorithmContract
from tests.unit.learning.test_replay import Line, box, make, record

# Vectors: achieved (1), desired (1), then the observation: effector, object, step.
SPACE = Line.observation_space
RELAY = {"effector": [0, 1], "object": [1, 2]}
TINY = {"effector": [0, 2], "object": [0, 2]}
ONE_AXIS = {"effector": [0, 1], "object": [1, 2]}  # of a goal of two numbers


def vectors(*rows: list[float]) -> np.ndarray:
    return np.array(rows, np.float32)


def test_the_flag_is_the_last_number() -> None:
    relay = Relay(SPACE, **RELAY)
    assert relay.with_flag(vectors([1, 2, 3, 4, 5])).tolist() == [[1, 2, 3, 4, 5, 0]]
    flagged = relay.with_flag(vectors([1, 2, 3, 4, 5], [6, 7, 8, 9, 0]), np.array([0, 1]))
    assert flagged[:, -1].tolist() == [0, 1] and flagged.dtype == np.float32


def test_an_exploring_effector_far_from_the_object_follows_it_half_of_the_time() -> None:
    relay = Relay(SPACE, **RELAY, far=0.5)
    far, near = [0, -5, 1.0, 2.0, 0], [0, -5, 1.0, 1.4, 0]
    np.random.seed(0)
    chosen = relay.choose_goals(vectors(*[far] * 400, *[near] * 400))
    follows = chosen[:, -1] == 1
    assert 150 < follows[:400].sum() < 250 and not follows[400:].any()
    assert set(chosen[follows, 1]) == {2.0}  # the object's place is the desired goal
    assert set(chosen[~follows, 1]) == {-5.0}


def test_the_first_goal_is_paid_by_the_distance_of_the_effector() -> None:
    relay = Relay(SPACE, **RELAY, threshold=0.5)
    after = vectors([9, 9, 1.0, 0, 0], [9, 9, 1.0, 0, 0], [9, 9, 1.0, 0, 0])
    assert relay.rewards(after, vectors([1.5], [1.6], [-1.0])).tolist() == [0, -1, -1]


def test_half_of_each_batch_has_the_first_goal() -> None:
    """Line's observation is (environment, episode, step); here episode and step are the places."""
    relay = Relay(SPACE, effector=[2, 3], object=[1, 2], threshold=0.5)
    buffer = make(relay=relay)
    record(buffer, [4, 6, 5])
    batch = buffer.sample_arrays(4000)
    flags = batch.observations[:, -1]
    assert flags[:100].sum() == 50 and flags[:2].sum() == 1  # also of the smallest batch
    assert (batch.next_observations[:, -1] == flags).all()
    first, after = batch.observations[flags == 1], batch.next_observations[flags == 1]
    goal, episode, step = first[:, 1], first[:, 3], first[:, 4]
    lengths = np.array([4, 6, 5])[episode.astype(int)]
    relabeled = goal > step  # a later place of the effector in the same episode
    assert 0.75 < relabeled.mean() <= 0.85
    assert (goal[relabeled] <= lengths[relabeled]).all()
    assert (goal[~relabeled] == episode[~relabeled]).all()  # where the object is
    assert (after[:, 1] == goal).all()
    expected = -(np.abs(after[:, 4] - goal) > 0.5).astype(float)
    assert batch.rewards[flags == 1].tolist() == expected.tolist()
    assert not batch.terminated[flags == 1].any()


def test_the_other_half_is_the_one_without_a_relay() -> None:
    relay = Relay(SPACE, effector=[2, 3], object=[1, 2])
    plain, with_relay = make(), make(relay=relay)
    for buffer in (plain, with_relay):
        record(buffer, [4, 6, 5])
    one, other = plain.sample_arrays(64), with_relay.sample_arrays(64)
    is_task = other.observations[:, -1] == 0
    np.testing.assert_array_equal(one.observations[is_task], other.observations[is_task][:, :-1])
    np.testing.assert_array_equal(one.rewards[is_task], other.rewards[is_task])


# As in Blocks with a goal for the gripper: the goal is twice as long as a place.
TOWER = spaces.Dict({key: box(4) for key in ("achieved_goal", "desired_goal", "observation")})


def test_in_a_longer_goal_the_first_one_takes_the_first_numbers() -> None:
    relay = Relay(TOWER, effector=[0, 2], object=[2, 4], threshold=1.0, follow=1.0)
    row = vectors([1, 2, 3, 4, 5, 6, 7, 8, 10, 20, 30, 40])  # achieved, desired, observation
    assert relay.choose_goals(row).tolist() == [[1, 2, 3, 4, 30, 40, 0, 0, 10, 20, 30, 40, 1]]
    assert relay.rewards(row, vectors([10, 20.5], [10, 21.5])).tolist() == [0, -1]


class Tower(gym.Env):
    """Judges goals that are twice as long as a place."""

    observation_space, action_space = TOWER, Line.action_space

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -np.any(achieved != desired, axis=-1).astype(float)


def test_what_is_relabeled_in_a_longer_goal() -> None:
    """One step: the effector goes from (1, 2) to (3, 4), and the object lies at (5, 6)."""
    relay = Relay(TOWER, effector=[0, 2], object=[2, 4], threshold=0.5)
    vector = DummyVecEnv([Tower])
    buffer = HindsightReplayBuffer(
        100, TOWER, vector.action_space, vector, device="cpu", seed=7, relay=relay
    )
    achieved, desired = np.array([[1.0, 1, 1, 1]]), np.array([[9.0, 9, 9, 9]])
    now, after = (
        {"achieved_goal": achieved * n, "desired_goal": desired, "observation": np.array([place])}
        for n, place in enumerate([[1.0, 2, 5, 6], [3.0, 4, 5, 6]], start=1)
    )
    end = {"TimeLimit.truncated": True}
    buffer.add(now, after, np.zeros((1, 2)), np.array([-1.0]), np.array([True]), [end])
    batch = buffer.sample_arrays(400)
    outcomes = {
        (*goal, flag, reward)
        for goal, flag, reward in zip(
            batch.observations[:, 4:8].tolist(),
            batch.observations[:, -1],
            batch.rewards,
            strict=True,
        )
    }
    assert outcomes == {
        (9, 9, 9, 9, 0, -1),  # the task as it was asked for
        (2, 2, 2, 2, 0, 0),  # the goal that was reached
        (5, 6, 0, 0, 1, -1),  # the effector should have gone to the object
        (3, 4, 0, 0, 1, 0),  # or where it went
    }
    np.testing.assert_array_equal(batch.next_observations[:, 4:8], batch.observations[:, 4:8])


def test_goals_may_be_those_that_other_episodes_asked_for() -> None:
    buffer = make(desired_share=0.25)
    record(buffer, [4, 6, 5])
    goals = buffer.sample_arrays(8000).observations[:, 1]
    # A fifth keeps its goal, -5; of the other four fifths a quarter is another episode's -5.
    assert (goals == -5.0).mean() == pytest.approx(0.2 + 0.8 * 0.25, abs=0.02)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"effector": [0, 1]}, "needs object"),
        ({**RELAY, "efector": 1}, "Did you mean 'effector'"),
        ({**RELAY, "object": [2, 4]}, "within the 3 numbers"),
        ({**RELAY, "object": [0, 2]}, "equally long and at most 1 long as the desired goal"),
        ({"effector": [0, 2], "object": [1, 3]}, "name fewer coordinates"),
        ({**RELAY, "object": 1}, r"object must be \[from, to\] .* but it is 1"),
        ({**RELAY, "object": "12"}, "but it is '12'"),
        ({**RELAY, "far": "away"}, "relay.far must be a number, but it is 'away'"),
        (True, "must be null or a mapping, .* but it is True"),
    ],
)
def test_what_does_not_fit_is_refused(given: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_relay(given, SPACE)


def test_it_needs_goals_and_our_replay_buffer() -> None:
    with pytest.raises(ConfigError, match="environment with goals"):
        make_relay(RELAY, spaces.Box(-1, 1, (3,)))
    with pytest.raises(ConfigError, match="desired_share must be from 0 to 1"):
        make(desired_share=1.5)
    assert make_relay(None, SPACE) is None


def documented_places() -> Iterator[Any]:
    """Yield task, effector, object and what the object is from the table of the page on goals."""
    page = Path(__file__).parents[3] / "docs" / "explain" / "goals.md"
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("| `"):
            tasks, effector, thing, what = line.strip("|").split("|")
            for task in re.findall("`(.+?)`", tasks):
                yield pytest.param(
                    task, json.loads(effector), json.loads(thing), what, id=f"{task}{what}"
                )


def places(env: Any, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return where effector and object are in the simulation."""
    if hasattr(env, "sim"):  # PyBullet
        name = "object1" if "object1" in env.sim._bodies_idx else "object"
        return env.robot.get_ee_position(), env.sim.get_base_position(name)
    if hasattr(env, "inner"):  # Meta-World
        return env.inner.get_endeff_pos(), env.inner._get_pos_objects()[:3]
    names = {env.model.body(index).name for index in range(env.model.nbody)}
    body = "hook" if "the hook" in what else ({"block0", "object0"} & names).pop()
    return env.data.site("robot0:grip").xpos, env.data.body(body).xpos


@pytest.mark.parametrize(("task", "effector", "thing", "what"), list(documented_places()))
def test_the_documented_places_are_those_of_effector_and_object(
    task: str, effector: list[int], thing: list[int], what: str
) -> None:
    for prefix, package in {"Panda": "panda_gym", "MetaW": "metaworld"}.items():
        if task.startswith(prefix):
            pytest.importorskip(package)
    env = make_single_env(RunConfig(resolve_env_id(task)[0]))
    assert make_relay({"effector": effector, "object": thing}, env.observation_space) is not None
    env.reset(seed=1)
    for _ in range(5):
        observation = env.step(env.action_space.sample())[0]["observation"]
    found = observation[slice(*effector)], observation[slice(*thing)]
    np.testing.assert_allclose(found, places(env.unwrapped, what), atol=1e-5)
    env.close()


@pytest.mark.parametrize("algorithm", ["jaxsac", "jaxtd3"])
@pytest.mark.parametrize("places", [TINY, ONE_AXIS], ids=["equal", "longer goal"])
def test_resumes_exactly(algorithm: str, places: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("jax")
    contract = AlgorithmContract()
    contract.algorithm, contract.env = algorithm, "scilab_rl.testing:TinyReach-v0"
    contract.arguments = {"relay": {**places, "far": -1.0}, "normalize_observations": True}
    model = contract.trained()
    assert model.n_observations == 7 and model.relay is not None
    assert isinstance(model.replay_buffer, HindsightReplayBuffer)
    contract.test_continues_as_if_it_had_not_been_interrupted(tmp_path)


def test_needs_our_own_replay_buffer() -> None:
    pytest.importorskip("jax")
    contract = AlgorithmContract()
    contract.algorithm, contract.env = "jaxsac", "scilab_rl.testing:TinyReach-v0"
    contract.arguments = {"relay": TINY, "replay_buffer_class": "her"}
    with pytest.raises(ConfigError, match="our own hindsight replay"):
        contract.build()
