from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
import torch

import scilab_rl.testing
from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.algorithms.random import RANDOM
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_eval_env, make_train_env, observed_layer
from scilab_rl.errors import RenderingError
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.metrics.probes import Curve, resolve_metrics
from scilab_rl.recording.callback import leave_out_impossible_pictures
from scilab_rl.recording.records import ClipInfo, Record, decode_picture
from scilab_rl.recording.timeline import Timeline

N_STEPS = 10


class Collector:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.clips: list[list[Record]] = []
        self.n_ended = 0

    def begin(self, clip: ClipInfo) -> None:
        self.clips.append([])

    def add(self, record: Record) -> None:
        self.clips[-1].append(record)

    def end(self) -> None:
        self.n_ended += 1


def describe(epoch: int, episode: int) -> ClipInfo:
    return ClipInfo("x", "eval", epoch, "TinyPixels-v0", "random", 25.0, ("reward",))


def make_timeline(
    sink: Any, *, n_envs: int = 1, frames: bool = True, **more: Any
) -> tuple[Any, Timeline]:
    mode = "rgb_array" if frames else None
    env = make_train_env(RunConfig("TinyPixels-v0", n_envs=n_envs, seed=1), mode)
    inspector = AgentInspector(RANDOM(env=env))
    shown = resolve_metrics(["reward"], inspector, (), key="k", algorithm_name="random")
    timeline = Timeline(observed_layer(env), inspector, shown, describe, [sink], **more)
    return env, timeline


def play(env: Any, n_steps: int) -> None:
    for _ in range(n_steps):
        env.step(np.zeros((env.num_envs, 1), np.float32))


def places(records: list[Record]) -> list[tuple[int, int]]:
    """Return episode and step of each record as its pixels say them."""
    return [scilab_rl.testing.decode_frame(decode_picture(record.picture)) for record in records]


def test_one_episode_from_its_first_to_its_last_scene() -> None:
    sink = Collector()
    env, timeline = make_timeline(sink, n_envs=4)
    timeline.show(1)
    env.reset()
    play(env, 35)
    assert len(sink.clips) == sink.n_ended == 1
    (records,) = sink.clips
    assert places(records) == [(0, step) for step in range(N_STEPS + 1)]
    assert [record.step for record in records] == list(range(N_STEPS + 1))
    assert [record.total_steps for record in records] == [4 * step for step in range(N_STEPS + 1)]
    assert [record.is_last_scene for record in records] == [False] * N_STEPS + [True]
    assert [record.values.get(Curve("reward")) for record in records[-2:]] == [
        pytest.approx(0.1),
        None,
    ]
    assert records[-2].truncated
    assert records[0].events == ["episode start"]


def test_showing_begins_with_the_next_episode() -> None:
    sink = Collector()
    env, timeline = make_timeline(sink)
    env.reset()
    play(env, 3)
    timeline.show(1)
    play(env, 40)
    (records,) = sink.clips
    assert places(records) == [(1, step) for step in range(N_STEPS + 1)]


def test_clip_of_a_number_of_scenes_goes_over_episodes() -> None:
    sink = Collector()
    env, timeline = make_timeline(sink, frames_per_clip=14)
    timeline.show(1)
    env.reset()
    play(env, 40)
    (records,) = sink.clips
    assert places(records) == [(0, s) for s in range(11)] + [(1, s) for s in range(3)]


def test_closing_keeps_what_there_is() -> None:
    sink = Collector()
    env, timeline = make_timeline(sink)
    timeline.show(1)
    env.reset()
    play(env, 3)
    timeline.close()
    play(env, 30)
    assert len(sink.clips) == sink.n_ended == 1
    assert len(sink.clips[0]) == 3


def test_nothing_is_asked_of_steps_that_are_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    env, timeline = make_timeline(Collector())
    monkeypatch.setattr(timeline, "_record", pytest.fail)
    monkeypatch.setattr(env.envs[0].unwrapped, "render", pytest.fail)
    env.reset()
    play(env, 25)
    assert not timeline.sinks[0].clips


@pytest.fixture
def messages(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> pytest.LogCaptureFixture:
    """What the package says; the command line keeps its messages from the root logger."""
    monkeypatch.setattr(logging.getLogger("scilab_rl"), "propagate", True)
    return caplog


def test_broken_sink_is_switched_off_and_the_others_go_on(
    messages: pytest.LogCaptureFixture,
) -> None:
    class Broken(Collector):
        def add(self, record: Record) -> None:
            raise OSError("disk full")

    sink = Collector()
    env, timeline = make_timeline(Broken())
    timeline.sinks.append(sink)
    timeline.show(1)
    env.reset()
    play(env, 20)
    assert len(sink.clips[0]) == N_STEPS + 1
    assert messages.messages == ["Broken is switched off: OSError: disk full. Training continues."]


def test_renderer_that_fails_in_the_middle_costs_pictures_and_nothing_else(
    messages: pytest.LogCaptureFixture,
) -> None:
    sink = Collector()
    env, timeline = make_timeline(sink)
    timeline.show(1)
    env.reset()
    play(env, 4)
    env.envs[0].unwrapped.render = None  # not callable
    play(env, 20)
    records = sink.clips[0]
    assert [record.step for record in records] == list(range(N_STEPS + 1))
    assert [bool(record.picture) for record in records] == [True] * 5 + [False] * 6
    assert [record.values.get(Curve("reward")) for record in records][-2:] == [
        pytest.approx(0.1),
        None,
    ]
    assert sink.n_ended == 1
    assert len(messages.messages) == 1
    assert messages.messages[0].startswith("Scenes without picture: TypeError")


def test_recorded_values_belong_to_the_step_that_is_complete() -> None:
    """What is recorded before and after `env.step`, up to the callback, belongs to that step."""
    sink, logger = Collector(), MetricLogger()
    env = make_train_env(RunConfig("TinyPixels-v0", seed=1), "rgb_array")
    inspector = AgentInspector(RANDOM(env=env))
    shown = resolve_metrics(
        ["a", "b", "c"], inspector, ["a", "b", "c"], key="k", algorithm_name="x"
    )
    timeline = Timeline(observed_layer(env), inspector, shown, describe, [sink], logger=logger)
    timeline.show(1)
    env.reset()
    for step in range(2 * N_STEPS):
        logger.record("a", step)
        play(env, 1)
        if step % 2:
            logger.record("b", step)
        timeline.complete_step()
        logger.record("c", step)  # by an update after the step: the networks of the next one
    (records,) = sink.clips
    assert [record.values.get(Curve("a")) for record in records[:-1]] == list(range(N_STEPS))
    assert [record.values.get(Curve("b")) for record in records[:4]] == [None, 1, None, 3]
    assert [record.values.get(Curve("c")) for record in records[:4]] == [None, 0, 1, 2]


def test_watched_training_is_the_same_as_unwatched() -> None:
    """Bit for bit: probes and pictures change neither weights nor random numbers."""
    weights = [_train(watched) for watched in (False, True)]
    for unwatched, watched in zip(*weights, strict=True):
        assert torch.equal(unwatched, watched)


def _train(watched: bool) -> list[torch.Tensor]:
    env = make_train_env(RunConfig("TinyPixels-v0", seed=5), "rgb_array")
    algorithm = CLEANSAC(env=env, net_arch=[8], learning_starts=15, batch_size=8, seed=2)
    inspector = AgentInspector(algorithm)
    names = ["q_values", "td_error", "entropy", "log_prob", "action"]
    shown = resolve_metrics(names, inspector, (), key="k", algorithm_name="cleansac")
    sink = Collector()
    timeline = Timeline(observed_layer(env), inspector, shown, describe, [sink])
    if watched:
        timeline.show(1, n_clips=5)
    algorithm.learn(60)
    assert len(sink.clips) == (5 if watched else 0)
    return [parameter.detach().clone() for parameter in algorithm.critic.parameters()]


def test_evaluation_on_the_simulator_is_the_same_as_unwatched() -> None:
    """MuJoCo's state is put back after each picture, so that not even the last bit differs."""
    pytest.importorskip("gymnasium_robotics")
    from scilab_rl.errors import RenderingError
    from scilab_rl.recording.gl import choose_backend

    try:
        choose_backend()
    except RenderingError as error:
        pytest.skip(str(error))
    rewards = []
    for watched in (False, True):
        env = make_eval_env(RunConfig("FetchPushDense-v4", seed=3), "rgb_array")
        env.env_method("capture_frames", watched)
        env.reset()
        generator = np.random.default_rng(0)
        rewards.append(
            [env.step(generator.uniform(-1, 1, (1, 4)).astype(np.float32))[1][0] for _ in range(10)]
        )
        env.close()
    assert rewards[0] == rewards[1]


def test_without_opengl_a_mujoco_scene_has_its_numbers_and_is_never_rendered(
    messages: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> str:
        raise RenderingError("No picture can be drawn on this machine.")

    monkeypatch.setattr("scilab_rl.recording.gl.choose_backend", fail)
    env = make_train_env(RunConfig("Reach1DOF-v0", seed=1), "rgb_array")
    env.envs[0].unwrapped.render = None  # asking it could end the process
    leave_out_impossible_pictures(env)
    inspector = AgentInspector(RANDOM(env=env))
    shown = resolve_metrics(["reward"], inspector, (), key="k", algorithm_name="random")
    sink = Collector()
    Timeline(observed_layer(env), inspector, shown, describe, [sink], frames_per_clip=4).show(1)
    env.reset()
    play(env, 5)
    assert [(record.picture, record.values) for record in sink.clips[0]] == [
        (b"", {Curve("reward"): -1})
    ] * 4
    assert len(messages.messages) == 1
    assert "No picture can be drawn on this machine" in messages.messages[0]
