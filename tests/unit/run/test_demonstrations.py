"""Demonstrations: where they come from, how they are stored, and that a resume has them."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from scilab_rl.config.compose import compose
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.run.checks import complete
from scilab_rl.run.demonstrations import collect_demos, parse_demos, prepare_demos
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.parts import make_algorithm
from scilab_rl.run.run import resume_run, start_run
from scilab_rl.training import checkpoint
from scilab_rl.training.snapshot import capture, restore

REACH, MAZE = "FetchReach-v4", "PointGym-sparse-0.5-small_open_dgr-c1-rt0-s60"
SMALL = ["algorithm.buffer_size=2000", "tuned=false", "seed=3"]


def build(env, algorithm, demos, *more, collect=True):
    words = [f"env={env}", f"algorithm={algorithm}", *SMALL, *more]
    cfg = complete(compose([*words, *([f"algorithm.demos={demos}"] if demos else [])]))
    model = make_algorithm(cfg, make_train_env(cfg))
    prepare_demos(cfg, model)
    if collect:
        collect_demos(cfg, model)
    return model


def n_rows(ring):
    """Return how many rows the demonstrations take; all have ended."""
    _, start, now = ring._cursors[:, 0]
    assert start == now
    return now


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("scripted", "must be scripted:100, run:RUN"),
        ("scripted:0", "must be scripted:100"),
        ("scripted:a:3", "must be scripted:100"),
        ("script:3", "Did you mean 'scripted'"),
        ({"source": "scripted:3", "share": 1.0}, "share must be a number between 0 and 1"),
        ({"source": "scripted:3", "part": 0.5}, "no algorithm.demos.part"),
    ],
)
def test_what_is_not_a_source_is_refused(chosen, message) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_demos(chosen)


def test_sources_by_hand() -> None:
    assert parse_demos("run:last").n_episodes == 100
    assert parse_demos("minari:D4RL/pointmaze/umaze-v2") == parse_demos(
        {"source": "minari:D4RL/pointmaze/umaze-v2", "share": 0.5}
    )
    assert parse_demos("minari:D4RL/pointmaze/umaze-v2").n_episodes == 0


@pytest.mark.parametrize("algorithm", ["cleansac", "sac"])
def test_scripted_demonstrations_are_stored_as_the_agents_own_steps(algorithm) -> None:
    model = build(REACH, algorithm, "{source: scripted:2, share: 0.25}")
    ring = model.replay_buffer.demos
    assert n_rows(ring) == 2 * 51 and model.replay_buffer.demo_share == 0.25
    rows, actions = ring.rows[:51, 0], ring.actions[:50, 0]
    gripper, goal = rows[:, :3], rows[:, 3:6]  # achieved_goal comes first
    # The controller: straight to the goal, 5 cm per step and unit; stored in [-1, 1].
    expected = ((goal - gripper)[:50] / 0.05).clip(-1, 1)
    np.testing.assert_allclose(actions[:, :3], expected, atol=1e-5)
    assert np.linalg.norm(gripper[-1] - goal[-1]) < 0.05
    assert ring.rewards[49, 0] == 0.0 and not ring.terminated[:50].any()
    model.get_env().close()


def test_only_successes_are_kept_and_the_normalizer_knows_them() -> None:
    pytest.importorskip("jax")
    more = ["algorithm.normalize_observations=true"]
    model = build(MAZE, "jaxsac", "scripted:3", *more)
    ring = model.replay_buffer.demos
    assert model.normalizer.count == n_rows(ring)
    np.testing.assert_allclose(
        model.normalizer.mean, ring.rows[: n_rows(ring), 0].mean(axis=0), 1e-3
    )
    batch = model.replay_buffer.demos.sample_arrays(50)
    assert set(batch.rewards) <= {0.0, 1.0}
    model.get_env().close()


def test_a_runs_policy_demonstrates(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    model = build("Reach1DOF-v0", "cleansac", "run:agent:Reach1DOF:2")
    ring = model.replay_buffer.demos
    place, goal = ring.rows[: n_rows(ring), 0, 0], ring.rows[: n_rows(ring), 0, 1]
    assert abs(place[-1] - goal[-1]) < 0.05 and ring.actions.any()
    model.get_env().close()
    with pytest.raises(ConfigError, match="was trained in Reach1DOF-v0, which is not FetchReach"):
        build(REACH, "cleansac", "run:agent:Reach1DOF:2")


def test_a_data_set_of_minari(monkeypatch) -> None:
    rows = {"observation": np.zeros((4, 4)), "achieved_goal": np.arange(8.0).reshape(4, 2),
            "desired_goal": np.full((4, 2), 9.0)}  # fmt: skip
    episode = SimpleNamespace(
        observations=rows, actions=np.array([[1.0, 0.5]] * 3), rewards=np.array([0.0, 0.0, 1.0]),
        terminations=np.array([False, False, True]), truncations=np.zeros(3, bool),
    )  # fmt: skip
    data = SimpleNamespace(
        total_steps=6, total_episodes=2, iterate_episodes=lambda: iter([episode, episode])
    )
    fake = ModuleType("minari")
    fake.load_dataset = lambda name: {"maze/good": data}[name]
    monkeypatch.setitem(sys.modules, "minari", fake)
    model = build(MAZE, "cleansac", "minari:maze/good")
    ring = model.replay_buffer.demos
    assert n_rows(ring) == 8 and ring.rewards[:8, 0].tolist() == [0, 0, 1, 0, 0, 0, 1, 0]
    assert ring.terminated[:8, 0].tolist() == [0, 0, 1, 0, 0, 0, 1, 0]
    np.testing.assert_array_equal(ring.rows[3, 0, :2], [6.0, 7.0])
    model.get_env().close()
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(MissingDependencyError, match=r"scilab-rl\[minari\]"):
        build(MAZE, "cleansac", "minari:maze/good")


def test_a_resumed_run_has_the_same_demonstrations(tmp_path) -> None:
    model = build(MAZE, "cleansac", "scripted:2")
    checkpoint.save(capture({"algorithm": model}), tmp_path / "saved", step=0)
    resumed = build(MAZE, "cleansac", "scripted:2", collect=False)
    assert resumed.replay_buffer.demos.pos == 0
    restore({"algorithm": resumed}, checkpoint.load(tmp_path / "saved"))
    one, again = (m.replay_buffer.demos.sample_arrays(32) for m in (model, resumed))
    for name in one._fields:
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    with closing(model.get_env()), closing(resumed.get_env()):
        assert model.replay_buffer.demos.pos == resumed.replay_buffer.demos.pos > 0


@pytest.mark.parametrize(
    ("env", "more", "message"),
    [
        ("scilab_rl.testing:TinyBox-v0", [], "needs our own hindsight replay"),
        (REACH, ["++algorithm.replay_buffer_class=her"], "needs our own hindsight replay"),
        ("scilab_rl.testing:TinyReach-v0", [], "no scripted controller"),
    ],
)
def test_where_there_can_be_none(env, more, message) -> None:
    with pytest.raises(ConfigError, match=message):
        build(env, "cleansac", "scripted:2", *more)


def test_a_run_that_is_continued_ends_as_one_that_was_not_interrupted(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    words = [f"env={MAZE}", "algorithm=cleansac", "algorithm.demos=scripted:2", *SMALL, "mlflow=0",
             "algorithm.net_arch=[8]", "algorithm.batch_size=8", "eval_after_n_steps=130",
             "n_test_rollouts=1", "++tracking.console.enabled=false", "early_stop_threshold=2",
             "save_model_freq=1"]  # fmt: skip
    whole = start_run(compose([*words, "n_epochs=2"]))
    half = start_run(compose([*words, "n_epochs=1"]))
    directory = RunDirectory(Path(half.run_dir))
    # A resumed run needs its demonstrations from nowhere.
    monkeypatch.setattr("scilab_rl.run.run.collect_demos", None)
    resumed = resume_run(compose([*words, "n_epochs=2"]), directory)
    timeless = {k: v for k, v in whole.metrics.items() if not k.startswith("time/")}
    assert {k: v for k, v in resumed.metrics.items() if k in timeless} == timeless
    assert "train/critic_loss" in timeless
