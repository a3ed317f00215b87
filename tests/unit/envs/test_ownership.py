"""An environment that scribbles over what it was given and gave is recorded as an honest one."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_train_env, observed_layer


class Twin(gym.Env):
    """A point that moves; a scribbler keeps one buffer for all, and spoils it."""

    shared: dict = {}  # noqa: RUF012 - what all scribblers write to

    def __init__(self, scribbles: bool = False) -> None:
        self.scribbles = scribbles
        self.observation_space = spaces.Dict({"x": spaces.Box(-9, 9, (2,), np.float32)})
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self._given: list = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._spoil()
        self.x = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self._answer()

    def step(self, action):
        self._spoil()
        self.x = np.clip(self.x + action, -9, 9).astype(np.float32)
        if self.scribbles:
            action[:] = 77
        return self._answer()[0], float(self.x.sum()), bool(self.x[0] > 2), False, self._answer()[1]

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(achieved_goal - desired_goal).sum(-1)

    def _answer(self):
        observation = {"x": self.x.copy()}
        info = {"place": self.x.copy(), "deep": {"list": [self.x.copy()]}}
        if self.scribbles:
            Twin.shared.update(info)
            info = Twin.shared
        self._given += [observation, info]
        return observation, info

    def _spoil(self) -> None:
        if self.scribbles:
            for given in self._given:
                for key in ("x", "place"):
                    if key in given:
                        given[key][:] = 88
                if "deep" in given:
                    given["deep"]["list"][0][:] = 99
        self._given = []


gym.register("Twin-v0", f"{__name__}:Twin", max_episode_steps=5, disable_env_checker=True)


class Keeper:
    def __init__(self) -> None:
        self.kept, self.then = [], []

    def on_step(self, batch) -> None:
        self.kept.append((batch.observations, batch.actions, batch.next_observations, batch.infos))
        self.then.append(copy.deepcopy(self.kept[-1]))


def record(scribbles: bool, n_envs: int, vector: str):
    env = make_train_env(
        RunConfig(
            f"{__name__}:Twin-v0",
            env_kwargs={"scribbles": scribbles},
            n_envs=n_envs,
            vector=vector,
            seed=3,
        )
    )
    keeper = Keeper()
    observed_layer(env).observers.append(keeper)
    sent, rng = [], np.random.default_rng(0)
    try:
        resets = [env.reset(), copy.deepcopy(observed_layer(env).venv.reset_infos)]
        for _ in range(12):
            actions = rng.uniform(-1, 1, (n_envs, 2)).astype(np.float32)
            env.step(actions)
            sent.append(actions)
    finally:
        env.close()
    np.testing.assert_equal(keeper.kept, keeper.then)
    return resets, sent, keeper.kept


@pytest.mark.parametrize(
    ("n_envs", "vector"), [(1, "inprocess"), (3, "inprocess"), (2, "workers"), (2, "subprocess")]
)
def test_what_is_changed_in_place_changes_no_record(n_envs, vector):
    np.testing.assert_equal(record(True, n_envs, vector), record(False, n_envs, vector))
