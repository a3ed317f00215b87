import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import scilab_rl.testing  # noqa: F401 - registers the tiny environments
from scilab_rl.envs.fingerprint import fingerprint, scripted_action
from scilab_rl.testing.environments import TinyReach


def test_it_does_not_depend_on_what_happened_before():
    env = gym.make("TinyReach-v0")
    first = fingerprint(env)
    env.reset(seed=5)
    env.step(env.action_space.sample())
    assert fingerprint(env) == first == fingerprint(gym.make("TinyReach-v0"))
    assert len(first) == 16


def test_it_is_the_same_in_another_process():
    code = (
        "import gymnasium as gym, scilab_rl.testing; "
        "from scilab_rl.envs.fingerprint import fingerprint; "
        "print(fingerprint(gym.make('TinyReach-v0')))"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert printed.strip() == fingerprint(gym.make("TinyReach-v0"))


def changed(**attributes):
    env = TinyReach()
    for name, value in attributes.items():
        setattr(env, name, value)
    return fingerprint(env)


def test_it_changes_with_dynamics_rewards_and_first_states():
    class OtherStart(TinyReach):
        def _random_place(self):
            return super()._random_place() * np.float32(1.001)

    prints = [
        fingerprint(TinyReach()),
        changed(STEP_LENGTH=0.2501),
        changed(THRESHOLD=0.6),
        fingerprint(OtherStart()),
        fingerprint(gym.make("TinyBox-v0")),
    ]
    assert len(set(prints)) == len(prints)


def test_it_ignores_the_last_bits():
    class AlmostEqual(TinyReach):
        def _observe(self):
            return {key: value + 1e-9 for key, value in super()._observe().items()}

    assert fingerprint(AlmostEqual()) == fingerprint(TinyReach())


def test_fetch_has_the_known_good_one():
    from scilab_rl.config.schema import RunConfig
    from scilab_rl.envs.vectorize import make_single_env

    one, two = (make_single_env(RunConfig("FetchReach-v4")) for _ in range(2))
    assert fingerprint(one) == fingerprint(two)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-2.0, 3.0, (3,), np.float32),
        spaces.Box(-np.inf, np.inf, (2,), np.float64),
        spaces.Discrete(4, start=2),
        spaces.MultiDiscrete([2, 5]),
        spaces.MultiBinary(3),
        spaces.Dict({"a": spaces.Discrete(3)}),
    ],
    ids=lambda space: type(space).__name__,
)
def test_scripted_actions_are_allowed_and_repeat(space):
    first, second = (
        [scripted_action(space, rng) for _ in range(5)]
        for rng in (np.random.default_rng(1), np.random.default_rng(1))
    )
    assert all(space.contains(action) for action in first)
    assert repr(first) == repr(second)
