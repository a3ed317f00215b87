"""What is learned, stored, exported and filmed is the same with an environment that scribbles."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_eval_env, make_train_env, observed_layer
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.learning.replay import HindsightReplayBuffer
from scilab_rl.metrics.probes import resolve_metrics
from scilab_rl.recording.records import ClipInfo
from scilab_rl.recording.timeline import Timeline
from scilab_rl.training.trajectory_table import collect


class Goals(gym.Env):
    """A point with a goal; a scribbler spoils all that it was given or has given before."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, scribbles: bool = False, render_mode: str | None = None) -> None:
        self.scribbles, self.render_mode = scribbles, render_mode
        place = spaces.Box(-100, 100, (2,), np.float32)
        self.observation_space = spaces.Dict(
            {"observation": place, "achieved_goal": place, "desired_goal": place}
        )
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self._given: list = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._spoil()
        self.x, self.goal = self.np_random.uniform(-1, 1, (2, 2)).astype(np.float32)
        return self._answer()

    def step(self, action):
        self._spoil()
        self.x = (self.x + action).astype(np.float32)
        reward = float(self._reward(self.x, self.goal))
        if self.scribbles:
            action[:] = 55
        observation, info = self._answer()
        return observation, reward, False, False, info

    def _reward(self, achieved, desired):
        return -np.abs(achieved - desired).sum(-1)

    def compute_reward(self, achieved_goal, desired_goal, info):
        reward = self._reward(achieved_goal, desired_goal)
        if self.scribbles:
            achieved_goal[...] = 66
            desired_goal[...] = 44
        return reward

    def render(self):
        return np.full((8, 8, 3), int(abs(self.x[0]) * 20) % 255, np.uint8)

    def _answer(self):
        x = self.x.copy
        observation = {"observation": x(), "achieved_goal": x(), "desired_goal": self.goal.copy()}
        info = {"place": x(), "is_success": bool(self.x[0] > 0)}
        self._given = [*observation.values(), info["place"], info]
        return observation, info

    def _spoil(self):
        for given in self._given if self.scribbles else ():
            if isinstance(given, dict):
                given["is_success"] = not given["is_success"]
            else:
                given[...] = 77


gym.register("Goals-v0", f"{__name__}:Goals", max_episode_steps=6, disable_env_checker=True)


class Sink:
    def __init__(self) -> None:
        self.records: list = []

    def begin(self, clip) -> None: ...

    def add(self, record) -> None:
        self.records.append(vars(record) if hasattr(record, "__dict__") else record)

    def end(self) -> None: ...


def _settings(scribbles, **more):
    return RunConfig(f"{__name__}:Goals-v0", env_kwargs={"scribbles": scribbles}, seed=3, **more)


def _learned(scribbles: bool, n_envs: int, vector: str) -> tuple:
    env = make_train_env(_settings(scribbles, n_envs=n_envs, vector=vector))
    try:
        model = CLEANSAC(
            env=env, seed=1, buffer_size=90, batch_size=16, learning_starts=20, net_arch=[8],
            replay_buffer_class=HindsightReplayBuffer,
        )  # fmt: skip
        model.learn(60)
    finally:
        env.close()
    buffer = {
        key: value
        for key, value in vars(model.replay_buffer).items()
        if isinstance(value, (np.ndarray, dict)) and key != "observation_space"
    }
    networks = [part for part in vars(model).values() if isinstance(part, torch.nn.Module)]
    weights = [w.detach().numpy() for network in networks for w in network.parameters()]
    return model, buffer, weights


def _shown(model, scribbles: bool) -> tuple:
    env = make_eval_env(_settings(scribbles), "rgb_array")
    model.env = env
    inspector, sink = AgentInspector(model), Sink()
    shown = resolve_metrics(
        ["q_value", "goal_distance"], inspector, (), key="k", algorithm_name="cleansac"
    )
    about = ClipInfo("x", "eval", 1, "Goals-v0", "cleansac", 25.0, shown.names)
    timeline = Timeline(observed_layer(env), inspector, shown, lambda *_: about, [sink])
    timeline.show(1)
    rows = collect(model, env, 2, seed=4)
    timeline.close()
    env.close()
    return rows, sink.records


@pytest.mark.parametrize(("n_envs", "vector"), [(1, "inprocess"), (2, "inprocess"), (2, "workers")])
def test_scribbling_changes_nothing_that_is_learned_or_shown(n_envs, vector) -> None:
    honest, *expected = _learned(False, n_envs, vector)
    spoiled, *actual = _learned(True, n_envs, vector)
    assert len(expected[0]) > 3 and len(expected[1]) > 3
    np.testing.assert_equal(actual, expected)
    rows, records = _shown(honest, False)
    assert len(rows) == 12 and len(records) > 5
    np.testing.assert_equal(_shown(spoiled, True), (rows, records))
