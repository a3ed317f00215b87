"""From a configuration to an algorithm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

from scilab_rl.building import build_algorithm

from .algorithms import conftest

make_env = conftest.make_env


@pytest.mark.parametrize("kind", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_given_as_one_number_gets_the_shape_of_actions(
    kind: Any, n_envs: int, make_env: Any
) -> None:
    arguments = {"action_noise": kind(0.5, 0.0), "buffer_size": 100}
    env = make_env("TinyReach-v0", n_envs)
    model = build_algorithm(DDPG, arguments, env, seed=1, device="cpu")
    noise = np.array(model.action_noise())
    assert noise.shape == ((2, 2) if n_envs == 2 else (2,))
    # Without deviation: normal noise is its mean; the other one is drawn to it by theta * dt.
    expected = 0.5 if kind is NormalActionNoise else 0.15 * 0.01 * 0.5
    np.testing.assert_allclose(noise, expected, rtol=1e-6)
    if kind is OrnsteinUhlenbeckActionNoise:
        np.testing.assert_allclose(model.action_noise(), expected * (2 - 0.0015), rtol=1e-6)
