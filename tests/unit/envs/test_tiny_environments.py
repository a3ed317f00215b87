"""The environments of `scilab_rl.testing`: other tests rely on what is shown here."""

import copy
import pickle
import time

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from scilab_rl.testing import TINY_ENVIRONMENTS, decode_frame, register
from scilab_rl.testing.environments import TinyReach, encode_frame


def episode(env, seed, n=30):
    env.action_space.seed(seed)
    seen = [env.reset(seed=seed)]
    for _ in range(n):
        step = env.step(env.action_space.sample())
        seen.append(step)
        if step[2] or step[3]:
            seen.append(env.reset())
    return seen


@pytest.mark.parametrize("env_id", TINY_ENVIRONMENTS)
def test_gymnasiums_own_check_is_passed(env_id):
    env = gym.make(env_id)
    # TinyPixels counts episodes on, so that its observations must differ after a reset
    if env_id != "TinyPixels-v0":
        check_env(env.unwrapped, skip_render_check=True)
    assert env.spec.max_episode_steps == TINY_ENVIRONMENTS[env_id][1]


@pytest.mark.parametrize("env_id", TINY_ENVIRONMENTS)
def test_a_seed_repeats_and_another_one_differs(env_id):
    one, two, other = (episode(gym.make(env_id), seed) for seed in (1, 1, 2))
    assert repr(one) == repr(two)
    assert repr(one) != repr(other) or env_id == "TinyPixels-v0"


@pytest.mark.parametrize("env_id", TINY_ENVIRONMENTS)
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_continue_in_the_middle_of_an_episode(env_id, copied):
    env = gym.make(env_id)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    twin = copied(env)
    for _ in range(25):
        action = env.action_space.sample()
        one, two = env.step(action), twin.step(action)
        assert repr(one) == repr(two)
        if one[2] or one[3]:
            assert repr(env.reset()) == repr(twin.reset())


@pytest.mark.parametrize("env_id", TINY_ENVIRONMENTS)
def test_a_step_costs_microseconds(env_id):
    env = gym.make(env_id)
    env.reset(seed=1)
    action, times = env.action_space.sample(), []
    for _ in range(300):
        started = time.perf_counter()
        done = any(env.step(action)[2:4])
        times.append(time.perf_counter() - started)
        if done:
            env.reset()
    assert np.median(times) < 200e-6  # about 20 on an idle machine


def test_registering_twice_changes_nothing():
    before = dict(gym.registry)
    register()
    assert dict(gym.registry) == before


def test_the_reward_of_reaching_by_hand():
    env = TinyReach()
    achieved = np.array([[0.0, 0.0], [0.0, 0.0], [0.3, 0.4]], np.float32)
    desired = np.array([[0.1, 0.1], [0.2, 0.1], [0.3, 0.4]], np.float32)
    # distances 0.141, 0.224 and 0 against a threshold of 0.2
    assert env.compute_reward(achieved, desired, {}).tolist() == [0.0, -1.0, 0.0]
    assert env.compute_reward(achieved[1], desired[1], {}) == -1.0
    assert not env.compute_terminated(achieved[2], desired[2], {})
    assert not env.compute_truncated(achieved[2], desired[2], {})


def test_moving_by_hand():
    env = gym.make("TinyReach-v0")
    start = env.reset(seed=1)[0]["achieved_goal"]
    observation, reward, *_, info = env.step(np.array([1.0, -0.5], np.float32))
    expected = np.clip(start + np.array([0.25, -0.125]), -1.0, 1.0)
    assert observation["achieved_goal"] == pytest.approx(expected, abs=1e-6)
    distance = np.linalg.norm(expected - observation["desired_goal"])
    assert (reward == 0.0) == info["is_success"] == (distance <= 0.2)


def test_steering_to_the_goal_succeeds_in_every_version():
    for env_id in ("TinyReach-v0", "TinyReachDiscrete-v0", "TinyBox-v0"):
        env = gym.make(env_id)
        for seed in range(20):
            observation, info = env.reset(seed=seed)
            truncated = False
            while not truncated:
                if isinstance(observation, dict):
                    away = observation["desired_goal"] - observation["achieved_goal"]
                else:
                    away = observation[2:] - observation[:2]
                action = np.clip(away / 0.25, -1, 1).astype(np.float32)
                if env_id == "TinyReachDiscrete-v0":
                    axis = int(np.argmax(np.abs(away)))
                    near = abs(away[axis]) <= 0.125
                    action = 4 if near else 2 * axis + int(away[axis] < 0)
                observation, _, _, truncated, info = env.step(action)
            assert info["is_success"]


def test_observations_are_not_changed_afterwards():
    env = gym.make("TinyReach-v0")
    kept = env.reset(seed=1)[0]
    before = copy.deepcopy(kept)
    for _ in range(5):
        env.step(np.ones(2, np.float32))
    assert repr(kept) == repr(before)


def test_the_corridor_pays_at_one_door_and_ends_at_both():
    env = gym.make("TinyDiscrete-v0")
    ends = set()
    for seed in range(10):
        for action in (0, 1):
            place, side = env.reset(seed=seed)[0]
            terminated, n_steps = False, 0
            while not terminated:
                _, reward, terminated, truncated, info = env.step(action)
                n_steps += 1
                assert terminated or reward == 0.0
            direction = 1.0 if action else -1.0
            assert n_steps == np.ceil((1.0 - direction * place) / 0.2 - 1e-6)
            assert (reward, info["is_success"]) == (direction * side, direction == side)
            assert not truncated
            ends.add(reward)
    assert ends == {1.0, -1.0}


@pytest.mark.parametrize("numbers", [(0, 0), (1, 2), (255, 256), (65535, 0), (0, 65535), (300, 77)])
def test_frames_hold_both_numbers(numbers):
    frame = encode_frame(*numbers)
    assert (frame.shape, frame.dtype) == ((64, 128, 3), np.uint8)
    assert decode_frame(frame) == numbers


# imageio's reader leaves the pipes of its ffmpeg to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_frames_survive_video_compression(tmp_path):
    env = gym.make("TinyPixels-v0", render_mode="rgb_array")
    frames, expected = [], []
    for number in range(6):
        env.reset(seed=1)
        for step in range(11):
            frames.append(env.render())
            expected.append((number, step))
            if step < 10:
                observation, reward, _, truncated, _ = env.step(env.action_space.sample())
                assert observation.tolist() == [number, step + 1]
                assert reward == number + (step + 1) / 100
        assert truncated
    film = tmp_path / "film.mp4"
    iio.imwrite(film, np.array(frames), fps=25, codec="libx264", quality=3)
    assert film.stat().st_size < np.array(frames).nbytes / 50
    assert [decode_frame(frame) for frame in iio.imread(film)] == expected
