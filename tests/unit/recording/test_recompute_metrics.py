from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import scilab_rl.testing  # noqa: F401 - registers the tiny environments
from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_train_env, observed_layer
from scilab_rl.errors import ConfigError
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.probes import resolve_metrics
from scilab_rl.recording.recompute_metrics import recompute_metrics
from scilab_rl.recording.records import Clip, ClipInfo, load_clip, save_clip
from scilab_rl.recording.timeline import Timeline

PROBES = ("q_values", "critic_variance", "td_error", "value", "log_prob", "return_so_far", "reward")
INFO = ClipInfo("x", "train", 1, "TinyPixels-v0", "cleansac", 25.0, PROBES)


class Keeper:
    def begin(self, clip: ClipInfo) -> None:
        self.clip = Clip(clip)

    def add(self, record: Any) -> None:
        self.clip.records.append(record)

    def end(self) -> None:
        pass


def make_mind(seed: int) -> AgentInspector:
    env = make_train_env(RunConfig("TinyPixels-v0", seed=1), "rgb_array")
    return AgentInspector(CLEANSAC(env=env, net_arch=[8], seed=seed))


def record_episode(inspector: AgentInspector) -> Clip:
    env, sink = inspector.algorithm.env, Keeper()
    shown = resolve_metrics(PROBES, inspector, (), key="k", algorithm_name="cleansac")
    timeline = Timeline(observed_layer(env), inspector, shown, lambda *_: INFO, [sink])
    timeline.show(1)
    observation = env.reset()
    for _ in range(10):
        observation = env.step(inspector.algorithm.predict(observation)[0])[0]
    return sink.clip


def test_same_networks_give_the_recorded_numbers_again(tmp_path: Any) -> None:
    """From the file: everything that a probe needs is stored."""
    inspector = make_mind(1)
    recorded = record_episode(inspector)
    save_clip(recorded, tmp_path / "x.npz")
    stored = load_clip(tmp_path / "x.npz")
    for record in stored.records:
        record.values = {}
    again = recompute_metrics(stored, {"finished": inspector}, PROBES, "cleansac")
    assert len(again.records) == 11
    for old, new in zip(recorded.records, again.records, strict=True):
        assert new.values == pytest.approx(old.values, rel=1e-6, abs=1e-7)
        assert new.values.keys() == old.values.keys()
    assert all(not record.values for record in stored.records)


def test_other_checkpoints_add_a_curve_each() -> None:
    inspectors = {"best": make_mind(1), "finished": make_mind(2)}
    clip = recompute_metrics(
        record_episode(make_mind(3)), inspectors, ["entropy", "q_values"], "cleansac"
    )
    assert clip.info.panels == (*PROBES, "entropy")
    assert set(clip.curves("entropy")) == {"best", "finished"}
    critics = ("critic 1", "critic 2")
    labels = {f"{policy}{critic}" for policy in ("", "best ", "finished ") for critic in critics}
    curves = clip.curves("q_values")
    assert set(curves) == labels
    assert len({np.round(curves[label][0] or 0.0, 8) for label in labels}) == len(labels)


def test_unknown_probe() -> None:
    inspector = make_mind(1)
    with pytest.raises(ConfigError, match="--metrics: there is no metric 'q_vaule'"):
        recompute_metrics(record_episode(inspector), {"best": inspector}, ["q_vaule"], "cleansac")
