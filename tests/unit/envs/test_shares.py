from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.envs.shares import _joined
from scilab_rl.envs.threads import ThreadsVecEnv
from scilab_rl.envs.workers import WorkersVecEnv


class Numbered(gym.Env):
    """Shows its number, how its last episode was begun, and what it was told."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - as Gymnasium has it

    def __init__(self, number: int) -> None:
        self.number, self.told, self.render_mode = number, None, "rgb_array"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.random()
        return np.array([self.number, draw]), {"seed": seed, "options": options}

    def step(self, action):
        terminated = bool(action[0] > 10)
        return np.array([self.number, action[0]]), float(action[0]), terminated, False, {"a": 1}

    def render(self):
        return np.full((2, 2, 3), self.number, np.uint8)

    def number_and(self, *arguments, **keywords):
        return self.number, arguments, keywords


def limited(number: int) -> gym.Env:
    return TimeLimit(Numbered(number), 3)


@pytest.fixture(params=[partial(WorkersVecEnv, start_method="fork"), ThreadsVecEnv])
def env(request):
    made = request.param([partial(limited, i) for i in range(5)], 2)
    yield made
    made.close()


def test_everything_is_as_in_one_process(env):
    one = DummyVecEnv([partial(limited, i) for i in range(5)])
    for vector in (one, env):
        vector.seed(7)
        vector.set_options([{"level": i} for i in range(5)])
    for _ in range(2):  # the second time without seeds and options
        assert one.reset()[:, 0].tolist() == env.reset()[:, 0].tolist() == [0, 1, 2, 3, 4]
        assert one.reset_infos == env.reset_infos
    one.seed(7), env.seed(7)
    assert one.reset().tolist() == env.reset().tolist()
    ended = []
    for t in range(8):
        actions = np.arange(5.0)[:, None] * (t + 1)
        ours, theirs = env.step(actions), one.step(actions)
        for mine, other in zip(ours[:3], theirs[:3], strict=True):
            assert mine.dtype == other.dtype
            assert mine.tolist() == other.tolist()
        assert repr(ours[3]) == repr(theirs[3])  # with terminal observations and truncation
        assert env.reset_infos == one.reset_infos
        ended += [(t, int(i), ours[3][i]["TimeLimit.truncated"]) for i in np.flatnonzero(ours[2])]
    assert (2, 0, True) in ended  # of the time limit
    assert (2, 4, False) in ended  # of its own
    assert repr(env.render()) == repr(one.render())


def test_chosen_environments_are_asked_and_answer_in_that_order(env):
    assert env.get_attr("number") == [0, 1, 2, 3, 4]
    assert env.get_attr("number", [4, 0, 3]) == [4, 0, 3]
    assert env.get_attr("number", 2) == [2]
    assert env.env_method("number_and", 7, b=8, indices=[3, 1]) == [
        (3, (7,), {"b": 8}),
        (1, (7,), {"b": 8}),
    ]
    env.set_attr("told", "yes", [1, 4])
    assert env.get_attr("told") == [None, "yes", None, None, "yes"]
    assert env.has_attr("number")
    assert not env.has_attr("absent")
    assert env.env_is_wrapped(TimeLimit, [2]) == [True]


def test_observations_of_every_kind_are_joined():
    parts = [np.zeros((2, 3)), np.ones((1, 3))]
    joined = _joined(parts)
    assert joined.tolist() == [[0] * 3, [0] * 3, [1] * 3]
    assert _joined([{"goal": part} for part in parts])["goal"].tolist() == joined.tolist()
    pair = _joined([(part, 2 * part) for part in parts])
    assert pair[1].tolist() == (2 * joined).tolist()
