"""The hindsight replay buffer, filled by hand: each observation says where it comes from."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from scipy import stats
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.building import build_algorithm
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.errors import ConfigError
from scilab_rl.learning.goal_functions import goal_reward, goal_termination
from scilab_rl.learning.observations import to_vector
from scilab_rl.learning.replay import GOAL_STRATEGIES, HindsightReplayBuffer, can_hold
from scilab_rl.training import checkpoint
from scilab_rl.training.snapshot import capture, restore

WANTED = -5.0  # a desired goal that is never reached


def box(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float64)


class Line(gym.Env):
    """Judges goals; its transitions are made by `record`."""

    observation_space = spaces.Dict(
        {"observation": box(3), "achieved_goal": box(1), "desired_goal": box(1)}
    )
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return -(np.abs(achieved - desired).sum(axis=-1) > 0.5).astype(np.float64)


class Ending(Line):
    """Reaching the goal ends the episode."""

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.abs(achieved - desired).sum(axis=-1) <= 0.5


class Unending(Line):
    """Answers for all goals at once that nothing ends, as the Fetch tasks do."""

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return False


class OneGoalAtATime(Line):
    """Cannot judge several endings at once, as the maze tasks."""

    def compute_terminated(self, achieved: Any, desired: Any, info: Any) -> Any:
        return bool(np.linalg.norm(achieved - desired) <= 0.5)


def make(size: int = 100, n_envs: int = 1, env: type[Line] = Line, **kwargs: Any) -> Any:
    vector = DummyVecEnv([env for _ in range(n_envs)])
    spaces_of = (vector.observation_space, vector.action_space)
    arguments = {"n_envs": n_envs, "seed": 7, "device": "cpu"} | kwargs
    return HindsightReplayBuffer(size, *spaces_of, vector, **arguments)


def observation(env: float, episode: float, step: float, goal: float = WANTED) -> dict[str, Any]:
    """Reaching the goal ``100 episode + step``, in the second environment 10,000 more."""
    place = [10_000.0 * env + 100.0 * episode + step]
    return {"observation": [env, episode, step], "achieved_goal": place, "desired_goal": [goal]}


def stack(observations: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {key: np.array([entry[key] for entry in observations]) for key in observations[0]}


def record(buffer: Any, *lengths: list[int], truncated: bool = True, first: int = 0) -> None:
    """Add episodes of these lengths, one list per environment, until all lists are used up.

    The action of a step is its number and the reward of the environment is -9.
    """
    plans = [
        [
            (env, first + number, step, length)
            for number, length in enumerate(plan)
            for step in range(length)
        ]
        for env, plan in enumerate(lengths)
    ]
    for steps in zip(*plans, strict=True):
        now = [observation(env, episode, step) for env, episode, step, _ in steps]
        after = [observation(env, episode, step + 1) for env, episode, step, _ in steps]
        done = np.array([step + 1 == length for _, _, step, length in steps])
        infos = [{"TimeLimit.truncated": bool(over and truncated)} for over in done]
        actions = np.array([[step, 0.0] for _, _, step, _ in steps], np.float32)
        buffer.add(stack(now), stack(after), actions, np.full(len(steps), -9.0), done, infos)


def drawn(buffer: Any, n: int = 4000) -> dict[str, np.ndarray]:
    """Sample and name the columns; the vector is (achieved, desired, env, episode, step)."""
    batch = buffer.sample_arrays(n)
    columns = {
        "achieved": batch.observations[:, 0],
        "desired": batch.observations[:, 1],
        "env": batch.observations[:, 2],
        "episode": batch.observations[:, 3],
        "step": batch.observations[:, 4],
    }
    following = {f"next_{name}": batch.next_observations[:, i] for i, name in enumerate(columns)}
    rest = {"action": batch.actions[:, 0], "reward": batch.rewards, "end": batch.terminated}
    return columns | following | rest | {"relabeled": columns["desired"] != WANTED}


def test_a_transition_leads_to_the_next_row_of_its_episode() -> None:
    buffer = make()
    record(buffer, [3, 5, 1, 4])
    seen = drawn(buffer)
    assert set(zip(seen["episode"], seen["step"], strict=True)) == {
        (episode, step) for episode, length in enumerate([3, 5, 1, 4]) for step in range(length)
    }
    np.testing.assert_array_equal(seen["next_step"], seen["step"] + 1)
    np.testing.assert_array_equal(seen["next_episode"], seen["episode"])
    np.testing.assert_array_equal(seen["next_desired"], seen["desired"])
    np.testing.assert_array_equal(seen["action"], seen["step"])


def goals(strategy: str, lengths: tuple[int, ...] = (3, 4)) -> dict[tuple[int, int], set[int]]:
    """Return which goals are put into each transition, as ``100 episode + step``."""
    buffer = make(goal_selection_strategy=strategy)
    record(buffer, list(lengths))
    seen = drawn(buffer)
    found: dict[tuple[int, int], set[int]] = {}
    columns = (seen[name][seen["relabeled"]] for name in ("episode", "step", "desired"))
    for episode, step, goal in zip(*columns, strict=True):
        found.setdefault((int(episode), int(step)), set()).add(int(goal))
    return found


def test_future_goals_are_reached_from_this_step_on_in_the_same_episode() -> None:
    assert goals("future") == {
        (0, 0): {1, 2, 3},
        (0, 1): {2, 3},
        (0, 2): {3},
        (1, 0): {101, 102, 103, 104},
        (1, 1): {102, 103, 104},
        (1, 2): {103, 104},
        (1, 3): {104},
    }


def test_final_goals_are_reached_at_the_end() -> None:
    assert goals("final") == {
        (episode, step): {100 * episode + length}
        for episode, length in enumerate((3, 4))
        for step in range(length)
    }


def test_episode_goals_are_reached_anywhere_in_the_episode() -> None:
    assert goals("episode") == {
        (episode, step): {100 * episode + reached for reached in range(1, length + 1)}
        for episode, length in enumerate((3, 4))
        for step in range(length)
    }


def test_random_goals_are_reached_in_any_episode() -> None:
    everything = {1, 2, 3, 101, 102, 103, 104}
    assert all(found == everything for found in goals("random").values())


def test_future_goals_are_uniform() -> None:
    buffer = make(goal_selection_strategy="future")
    record(buffer, [4])
    seen = drawn(buffer, 20_000)
    first = seen["desired"][seen["relabeled"] & (seen["step"] == 0)]
    counts = [(first == goal).sum() for goal in (1, 2, 3, 4)]
    assert stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize(("k", "share"), [(0, 0.0), (1, 0.5), (4, 0.8), (9, 0.9)])
def test_k_of_k_plus_one_transitions_are_relabeled(k: int, share: float) -> None:
    buffer = make(n_sampled_goal=k)
    record(buffer, [10])
    n = 20_000
    count = int(drawn(buffer, n)["relabeled"].sum())
    if k == 0:
        assert count == 0
    else:  # five standard deviations of a binomial distribution
        assert abs(count - n * share) < 5 * np.sqrt(n * share * (1 - share))


def test_every_batch_within_a_draw_has_its_share() -> None:
    buffer = make()
    record(buffer, [10])
    shares = drawn(buffer, 8 * 500)["relabeled"].reshape(8, 500).mean(axis=1)
    assert np.abs(shares - 0.8).max() < 5 * np.sqrt(0.8 * 0.2 / 500)


def test_transitions_are_drawn_uniformly() -> None:
    buffer = make(60, n_envs=2)
    # Different lengths in each environment, and rings that have gone round.
    record(buffer, [3, 9, 1, 6, 2, 8, 4, 7], [10, 5, 1, 1, 10, 3, 9, 1])
    seen = drawn(buffer, 30_000)
    places = np.stack([seen["env"], seen["episode"], seen["step"]], axis=1)
    _, counts = np.unique(places, axis=0, return_counts=True)
    assert len(counts) == n_complete(buffer)
    assert stats.chisquare(counts).pvalue > 1e-4


def n_complete(buffer: Any) -> int:
    """Count the transitions of ended episodes that are still there, from the cursors alone."""
    oldest, start, _ = buffer._cursors
    total = 0
    for env in range(buffer.n_envs):
        row = oldest[env]
        while row < start[env]:
            length = buffer.steps_left[row % buffer.buffer_size, env]
            total += length
            row += length + 1
    return int(total)


@pytest.mark.parametrize("strategy", GOAL_STRATEGIES)
@pytest.mark.parametrize("n_rows", [12, 13, 17, 29])
def test_a_full_ring_never_mixes_episodes(n_rows: int, strategy: str) -> None:
    buffer = make(2 * n_rows, n_envs=2, goal_selection_strategy=strategy)
    random = np.random.default_rng(n_rows)
    for number in range(0, 60, 2):
        one, other = (int(length) for length in random.integers(1, 6, size=2))
        record(buffer, [one, other], [other, one], first=number)
        seen = drawn(buffer, 100)
        np.testing.assert_array_equal(seen["next_episode"], seen["episode"])
        np.testing.assert_array_equal(seen["next_env"], seen["env"])
        np.testing.assert_array_equal(seen["next_step"], seen["step"] + 1)
        new = seen["relabeled"]
        if strategy != "random":
            of_episode = 10_000 * seen["env"] + 100 * seen["episode"]
            reached = (seen["desired"] - of_episode)[new]
            assert (reached >= 1).all()
            assert (reached <= 5).all()
        if strategy == "future":
            assert (reached > seen["step"][new]).all()
    assert buffer.full
    assert seen["episode"].max() == 59
    assert seen["episode"].min() > 40  # the oldest are gone


def test_the_running_episode_is_not_sampled_before_it_ends() -> None:
    buffer = make()
    record(buffer, [4])
    for step in range(3):
        one = stack([observation(0, 1, step)]), stack([observation(0, 1, step + 1)])
        buffer.add(*one, np.zeros((1, 2)), np.zeros(1), np.array([False]), [{}])
    assert set(drawn(buffer)["episode"]) == {0.0}
    buffer.truncate_last_trajectory()
    seen = drawn(buffer)
    assert set(seen["episode"]) == {0.0, 1.0}
    assert not seen["end"].any()  # cut off, not terminal
    assert seen["desired"][seen["episode"] == 1].max() == 103


def test_nothing_can_be_sampled_before_an_episode_has_ended() -> None:
    with pytest.raises(RuntimeError, match="learning_starts must be greater"):
        make().sample(1)


def test_an_observation_that_does_not_follow_begins_another_episode() -> None:
    buffer = make()
    for episode, step in [(0, 0), (0, 1), (1, 0), (1, 1)]:  # reset after two steps
        done = np.array([(episode, step) == (1, 1)])
        one = stack([observation(0, episode, step)]), stack([observation(0, episode, step + 1)])
        buffer.add(*one, np.zeros((1, 2)), np.zeros(1), done, [{"TimeLimit.truncated": True}])
    seen = drawn(buffer)
    np.testing.assert_array_equal(seen["next_episode"], seen["episode"])
    assert set(seen["desired"][seen["episode"] == 0]) == {WANTED, 1.0, 2.0}
    assert set(seen["desired"][seen["episode"] == 1]) == {WANTED, 101.0, 102.0}


def test_an_episode_longer_than_the_ring_forgets_its_beginning() -> None:
    buffer = make(6)
    record(buffer, [20])
    seen = drawn(buffer)
    assert set(seen["step"]) == {15.0, 16.0, 17.0, 18.0, 19.0}
    assert set(seen["desired"]) == {WANTED, 16.0, 17.0, 18.0, 19.0, 20.0}


def test_rewards_are_those_of_the_goal() -> None:
    buffer = make(goal_selection_strategy="future")
    record(buffer, [5])
    seen = drawn(buffer)
    original, new = ~seen["relabeled"], seen["relabeled"]
    assert set(seen["reward"][original]) == {-9.0}  # what the environment gave
    at_once = seen["next_achieved"] == seen["desired"]
    np.testing.assert_array_equal(seen["reward"][new], np.where(at_once, 0.0, -1.0)[new])
    assert set(seen["reward"][new]) == {-1.0, 0.0}


@pytest.mark.parametrize("kind", [Ending, OneGoalAtATime])
def test_endings_are_those_of_the_goal(kind: type[Line]) -> None:
    buffer = make(env=kind)
    record(buffer, [5], truncated=False)
    seen = drawn(buffer)
    at_once = seen["next_achieved"] == seen["desired"]
    new = seen["relabeled"]
    np.testing.assert_array_equal(seen["end"][new], at_once[new])
    np.testing.assert_array_equal(seen["end"][~new], seen["step"][~new] == 4)


def test_an_ending_for_another_reason_stays_where_the_environment_does_not_say() -> None:
    terminal, cut_off = make(), make()
    record(terminal, [5], truncated=False)
    record(cut_off, [5], truncated=True)
    seen = drawn(terminal)
    np.testing.assert_array_equal(seen["end"], seen["step"] == 4)
    assert not drawn(cut_off)["end"].any()


def test_a_constant_answer_holds_for_all_goals() -> None:
    buffer = make(env=Unending)
    record(buffer, [5], truncated=False)
    seen = drawn(buffer)
    assert not seen["end"][seen["relabeled"]].any()


def test_goals_may_change_within_an_episode() -> None:
    buffer = make(n_sampled_goal=0)
    for step in range(3):
        now, after = (observation(0, 0, s, goal=-float(s)) for s in (step, step + 1))
        done = np.array([step == 2])
        buffer.add(stack([now]), stack([after]), np.zeros((1, 2)), np.zeros(1), done, [{}])
    seen = drawn(buffer)
    np.testing.assert_array_equal(seen["desired"], -seen["step"])
    np.testing.assert_array_equal(seen["next_desired"], -seen["step"] - 1)


class Crashing(Line):
    """Its reward depends on what only the info tells."""

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        return np.array([-10.0 * entry["crashed"] for entry in info])


def test_numbers_of_the_infos_are_kept_for_the_reward() -> None:
    buffer = make(env=Crashing, info_keys=["crashed"])
    for step in range(4):
        one = stack([observation(0, 0, step)]), stack([observation(0, 0, step + 1)])
        info = {"crashed": step == 2, "TimeLimit.truncated": True}
        buffer.add(*one, np.zeros((1, 2)), np.zeros(1), np.array([step == 3]), [info])
    seen = drawn(buffer)
    new = seen["relabeled"]
    np.testing.assert_array_equal(seen["reward"][new], np.where(seen["step"] == 2, -10.0, 0)[new])


def test_samples_are_what_stable_baselines3_expects() -> None:
    buffer = make()
    record(buffer, [6])
    batch = buffer.sample(32)
    assert {key: tuple(entry.shape) for key, entry in batch.observations.items()} == {
        "achieved_goal": (32, 1),
        "desired_goal": (32, 1),
        "observation": (32, 3),
    }
    assert batch.actions.shape == (32, 2)
    assert batch.rewards.shape == batch.dones.shape == (32, 1)
    assert {entry.dtype for entry in batch.next_observations.values()} == {torch.float32}


def test_vectors_are_joined_as_the_algorithms_do() -> None:
    one, other = make(), make()
    record(one, [6])
    record(other, [6])
    apart, together = one.sample(32), other.sample_vectors(32)
    space = one.observation_space
    for name in ("observations", "next_observations"):
        joined = to_vector(getattr(apart, name), space, torch.device("cpu"))
        assert torch.equal(joined, getattr(together, name))
    assert torch.equal(apart.rewards, together.rewards)


def test_samples_are_normalised_as_by_stable_baselines3() -> None:
    env = VecNormalize(DummyVecEnv([Line]), clip_obs=50.0)
    for key in env.obs_rms:
        env.obs_rms[key].mean = env.obs_rms[key].mean + 2.0
        env.obs_rms[key].var = env.obs_rms[key].var * 4.0
    env.ret_rms.var = np.float64(4.0)
    buffer = make(n_sampled_goal=0)
    record(buffer, [6])
    batch = buffer.sample_arrays(64, env)
    steps = np.unique(batch.observations[:, 4].round(4))
    np.testing.assert_allclose(steps, (np.arange(6) - 2) / 2, atol=1e-3)  # (step - 2) / sqrt(4)
    np.testing.assert_allclose(batch.rewards, -9 / 2, rtol=1e-5)


def test_two_environments_keep_their_episodes_apart() -> None:
    buffer = make(80, n_envs=2)
    record(buffer, [3, 5, 4], [6, 2, 4])
    seen = drawn(buffer)
    np.testing.assert_array_equal(seen["next_env"], seen["env"])
    np.testing.assert_array_equal(seen["next_episode"], seen["episode"])
    owner = np.where(seen["desired"] >= 9_000, 1, 0)
    np.testing.assert_array_equal(owner[seen["relabeled"]], seen["env"][seen["relabeled"]])
    lengths = {(0, 0): 3, (0, 1): 5, (0, 2): 4, (1, 0): 6, (1, 1): 2, (1, 2): 4}
    assert set(zip(seen["env"], seen["episode"], seen["step"], strict=True)) == {
        (env, episode, step) for (env, episode), n in lengths.items() for step in range(n)
    }


@pytest.mark.parametrize("lengths", [[5, 3], [9, 9, 9, 9, 4]])
def test_a_restored_buffer_goes_on_bit_by_bit(lengths: list[int], tmp_path: Path) -> None:
    def begin(buffer: Any, n_steps: int, first: int) -> None:
        for step in range(first, first + n_steps):
            now, after = observation(0, 70, step), observation(0, 70, step + 1)
            buffer.add(stack([now]), stack([after]), np.ones((1, 2)), np.ones(1), [False], [{}])

    original, copy = make(30), make(30, seed=8)
    record(original, lengths)
    begin(original, 4, 0)
    original.sample(16)
    checkpoint.save(capture({"buffer": original}), tmp_path / "saved", step=1)
    restore({"buffer": copy}, checkpoint.load(tmp_path / "saved"))
    for buffer in (original, copy):
        begin(buffer, 2, 4)
        buffer.truncate_last_trajectory()
    one, other = original.sample_arrays(200), copy.sample_arrays(200)
    for ours, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    seen = drawn(copy)
    assert seen["step"][seen["episode"] == 70].max() == 5


def test_a_pickled_buffer_needs_an_environment_again() -> None:
    buffer = make()
    record(buffer, [6])
    copy = pickle.loads(pickle.dumps(buffer))
    copy.set_env(DummyVecEnv([Line]))
    np.testing.assert_array_equal(buffer.sample_arrays(50).rewards, copy.sample_arrays(50).rewards)


def test_it_takes_less_than_60_percent_of_the_memory() -> None:
    def n_bytes(buffer: Any) -> int:
        values = [
            entry
            for value in vars(buffer).values()
            for entry in (value.values() if isinstance(value, dict) else [value])
        ]
        return sum(value.nbytes for value in values if isinstance(value, np.ndarray))

    theirs = HerReplayBuffer(
        1000, Line.observation_space, Line.action_space, DummyVecEnv([Line]), device="cpu"
    )
    assert n_bytes(make(1000)) < 0.6 * n_bytes(theirs)


def test_the_seed_of_the_run_decides_what_is_drawn() -> None:
    def sample(seed: int) -> list[float]:
        np.random.seed(seed)
        buffer = make(seed=None)
        record(buffer, [9])
        return buffer.sample_arrays(20).observations[:, 4].tolist()

    assert sample(1) == sample(1) != sample(2)


def test_environments_of_other_processes_are_judged_by_a_copy_here() -> None:
    env = SubprocVecEnv([lambda: RunEnv(Ending())] * 2)
    try:
        reward, ending = goal_reward(env), goal_termination(env)
        env.step_async(np.zeros((2, 2)))  # its pipes are in use from here on
        achieved, desired = np.array([[1.0], [4.0], [7.0]]), np.array([[1.2], [5.0], [7.0]])
        assert reward(achieved, desired, [{}] * 3).tolist() == [0.0, -1.0, 0.0]
        assert ending is not None
        assert ending(achieved, desired, [{}] * 3).tolist() == [True, False, True]
    finally:
        for process in env.processes:
            process.terminate()


def test_environments_that_cannot_be_copied_are_asked_where_they_are() -> None:
    class Unpicklable(Ending):
        def __reduce__(self) -> Any:
            raise TypeError("no")

    env = SubprocVecEnv([lambda: RunEnv(Unpicklable())])
    try:
        reward = goal_reward(env)
        assert reward(np.array([[1.0], [4.0]]), np.ones((2, 1)), [{}] * 2).tolist() == [0.0, -1.0]
    finally:
        env.close()


def test_an_environment_without_a_reward_for_goals_is_refused() -> None:
    class Silent(gym.Env):
        observation_space, action_space = Line.observation_space, Line.action_space

    with pytest.raises(ConfigError, match="needs compute_reward"):
        make(env=Silent)  # type: ignore[arg-type]


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"episode, final, future, geometric, random.*'final'\?"):
        make(goal_selection_strategy="fnal")
    with pytest.raises(ConfigError, match="n_sampled_goal must be at least 0, but it is -1"):
        make(n_sampled_goal=-1)


def test_observations_of_other_kinds_are_left_to_stable_baselines3() -> None:
    assert can_hold(Line.observation_space)
    entries = dict(Line.observation_space.spaces)
    pixels = spaces.Box(0, 255, (8, 8, 3), np.uint8)
    assert not can_hold(spaces.Dict(entries | {"observation": pixels}))
    assert not can_hold(spaces.Dict(entries | {"achieved_goal": spaces.Discrete(3)}))
    assert not can_hold(spaces.Dict({"observation": box(2)}))
    assert not can_hold(box(2))


@pytest.mark.parametrize(("algorithm", "size"), [(CLEANSAC, {"net_arch": [8]}), (SAC, {})])
def test_auto_is_this_buffer_and_her_is_stable_baselines3s(
    make_env: Any, algorithm: Any, size: dict[str, Any]
) -> None:
    def build(chosen: str) -> Any:
        arguments = {"replay_buffer_class": chosen, "buffer_size": 500, "learning_starts": 40}
        env = make_env("TinyReach-v0", 2)
        return build_algorithm(algorithm, arguments | size, env, seed=1, device="cpu")

    model = build("auto")
    assert type(model.replay_buffer) is HindsightReplayBuffer
    assert type(build("her").replay_buffer) is HerReplayBuffer
    model.learn(60)
    assert type(build("auto").replay_buffer).__name__ == "HindsightReplayBuffer"
    assert model.replay_buffer.sample(8).actions.shape == (8, 2)


def still(episode: int, step: int) -> dict[str, np.ndarray]:
    """An observation of an episode in which nothing moves."""
    entries = observation(0, episode, step) | {"achieved_goal": [100.0 * episode]}
    return {key: np.array([value]) for key, value in entries.items()}


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0.25), (0.6, 0.7), (1.0, 1.0)])
def test_episodes_that_moved_something_are_preferred(share: float, expected: float) -> None:
    buffer = make(moved_share=share)
    for episode in (1, 2, 3):  # nothing moves in three of four episodes
        for step in range(5):
            place = still(episode, step), still(episode, step + 1)
            buffer.add(*place, np.zeros((1, 2)), np.zeros(1), np.array([step == 4]), [{}])
    record(buffer, [5], first=4)
    drawn = buffer.sample_arrays(4000).observations[:, :1]  # the achieved goal: 100 episode + step
    preferred = (drawn >= 400).mean()
    assert preferred == pytest.approx(expected, abs=0.03)


def test_episodes_that_were_dropped_are_not_preferred() -> None:
    buffer = make(24, moved_share=1.0)
    record(buffer, [5])  # moves, and is dropped by the fourth episode
    for episode in (2, 3, 4):
        for step in range(6):
            place = still(episode, step), still(episode, step + 1)
            buffer.add(*place, np.zeros((1, 2)), np.zeros(1), np.array([step == 5]), [{}])
    assert buffer.sample_arrays(100).observations[:, 0].min() >= 200  # 100 episode + step
    assert buffer._moved.size == 0


def test_preferring_what_does_not_exist_draws_from_all() -> None:
    buffer = make(moved_share=1.0)
    for step in range(5):
        place = still(1, step), still(1, step + 1)
        buffer.add(*place, np.zeros((1, 2)), np.zeros(1), np.array([step == 4]), [{}])
    assert len(buffer.sample_arrays(10).rewards) == 10
    with pytest.raises(ConfigError, match=r"moved_share must be from 0 to 1, but it is 1\.5"):
        make(moved_share=1.5)


def test_geometric_goals_are_reached_in_discounted_time() -> None:
    """P(k) is proportional to discount^(k - 1), up to the end of the episode."""
    buffer = make(goal_selection_strategy="geometric", discount=0.5, n_sampled_goal=1e9)
    record(buffer, [3])
    columns = drawn(buffer, 30_000)
    steps = columns["desired"] - columns["step"]
    for step, chances in {0: [4 / 7, 2 / 7, 1 / 7], 1: [2 / 3, 1 / 3], 2: [1]}.items():
        counts = np.unique(steps[columns["step"] == step], return_counts=True)[1]
        np.testing.assert_allclose(counts / counts.sum(), chances, atol=0.02)
        assert len(counts) == len(chances)


def test_goals_alone_need_no_reward() -> None:
    """Every transition is relabeled, and nothing asks the environment."""

    class Silent(Line):
        compute_reward = None  # type: ignore[assignment]

    buffer = make(env=Silent, goal_selection_strategy="geometric", goals_only=True)
    record(buffer, [3, 4], truncated=False)
    columns = drawn(buffer)
    assert columns["relabeled"].all()
    assert not columns["reward"].any() and not columns["end"].any()


@pytest.mark.parametrize("discount", [0.0, 1.0])
def test_geometric_goals_need_a_discount(discount: float) -> None:
    with pytest.raises(ConfigError, match="above 0 and below 1"):
        make(goal_selection_strategy="geometric", discount=discount)


def with_demos(share: float = 0.5, **kwargs: Any) -> Any:
    """Episodes 0 and 1 are the agent's own, 50 and 51 are demonstrations."""
    buffer = make(**kwargs)
    record(buffer, [3, 4])
    record(buffer.use_demos(9, share, seed=3), [3, 4], first=50)
    return buffer


@pytest.mark.parametrize(
    ("share", "places"),
    [(0.5, [2, 3, 6, 7, 10, 11]), (0.25, [6, 7]), (0.75, [2, 3, 4, 5, 6, 7, 10, 11])],
)
def test_demonstrations_have_their_places_in_a_batch(share: float, places: list[int]) -> None:
    buffer = with_demos(share)
    assert buffer.from_demos(12).nonzero()[0].tolist() == places
    seen = drawn(buffer, 12)
    assert (seen["episode"] >= 50).nonzero()[0].tolist() == places


def test_each_of_several_batches_has_its_share() -> None:
    seen = drawn(with_demos(), 16 * 256)
    assert ((seen["episode"] >= 50).reshape(16, 256).sum(axis=1) == 128).all()
    assert set(seen["episode"]) == {0.0, 1.0, 50.0, 51.0}


def test_demonstrations_are_relabeled_as_all_others() -> None:
    seen = drawn(with_demos())
    shown = seen["episode"] >= 50
    for part in (shown, ~shown):
        assert seen["relabeled"][part].mean() == pytest.approx(0.8, abs=0.03)
        chosen = part & seen["relabeled"]
        # A later place of the same episode: 100 * episode + step.
        np.testing.assert_array_equal(seen["desired"][chosen] // 100, seen["episode"][chosen])
        assert (seen["desired"][chosen] > seen["achieved"][chosen]).all()
        reached = seen["next_achieved"] == seen["desired"]
        assert (seen["reward"][chosen] == np.where(reached[chosen], 0.0, -1.0)).all()


def test_demonstrations_outlive_the_ring_and_a_checkpoint(tmp_path: Path) -> None:
    buffer = with_demos(size=12)
    record(buffer, [4] * 20, first=2)
    assert {50.0, 51.0} <= set(drawn(buffer)["episode"])
    checkpoint.save(capture({"buffer": buffer}), tmp_path / "c", step=1)
    other = make(size=12, seed=99)
    other.use_demos(9, 0.5, seed=98)
    restore({"buffer": other}, checkpoint.load(tmp_path / "c"))
    for one, again in zip(buffer.sample_arrays(64), other.sample_arrays(64), strict=True):
        np.testing.assert_array_equal(one, again)
