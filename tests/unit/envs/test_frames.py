import logging

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.envs.frames import FRAME_KEY, FrameCapture
from scilab_rl.envs.vectorize import EnvSettings, make_eval_env, observed_layer
from scilab_rl.testing import decode_frame


class Collecting:
    def __init__(self):
        self.seen = []

    def on_step(self, batch):
        self.seen.append((batch.rewards[0], batch.frames[0]))


def watched():
    settings = EnvSettings("scilab_rl.testing:TinyPixels-v0", render_mode="rgb_array")
    env, collecting = make_eval_env(settings), Collecting()
    observed_layer(env).observers.append(collecting)
    return env, collecting


def test_each_frame_belongs_to_its_step_also_the_last_of_an_episode():
    env, collecting = watched()
    env.env_method("capture_frames", True)
    env.reset()
    firsts = [decode_frame(observed_layer(env).reset_frame)]
    for _ in range(30):
        _, _, dones, _ = env.step(np.zeros((1, 1), np.float32))
        if dones[0]:
            firsts.append(decode_frame(observed_layer(env).reset_frame))
    assert firsts == [(0, 0), (1, 0), (2, 0), (3, 0)]
    decoded = [decode_frame(frame) for _, frame in collecting.seen]
    assert decoded == [(episode, step) for episode in range(3) for step in range(1, 11)]
    for (episode, step), (reward, _) in zip(decoded, collecting.seen, strict=True):
        assert reward == pytest.approx(episode + step / 100)


def test_without_the_switch_nothing_is_drawn():
    env, collecting = watched()
    env.reset()
    env.step(np.zeros((1, 1), np.float32))
    assert observed_layer(env).reset_frame is None
    assert collecting.seen[0][1] is None


def test_capturing_begins_with_an_episode_and_ends_at_once():
    env, collecting = watched()
    env.reset()
    env.env_method("capture_frames", True)
    for step in range(12):
        env.step(np.zeros((1, 1), np.float32))
        if step == 10:
            env.env_method("capture_frames", False)
    drawn = [frame is not None for _, frame in collecting.seen]
    assert drawn == [False] * 10 + [True, False]


def test_frames_do_not_stay_in_the_infos():
    env, _ = watched()
    env.env_method("capture_frames", True)
    env.reset()
    infos = env.step(np.zeros((1, 1), np.float32))[3]
    assert FRAME_KEY not in infos[0]


def test_a_renderer_that_fails_is_switched_off_and_the_task_goes_on(caplog):
    class Blind(gym.Wrapper):
        def render(self):
            raise OSError("no display")

    env = FrameCapture(Blind(gym.make("Pendulum-v1", render_mode="rgb_array")))
    env.capture_frames(True)
    with caplog.at_level(logging.WARNING):
        _, info = env.reset(seed=1)
        for _ in range(3):
            *_, info = env.step(env.action_space.sample())
    assert FRAME_KEY not in info
    assert caplog.messages == ["Rendering is switched off: OSError: no display"]
