"""From a configuration to an algorithm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DDPG, SAC
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


@pytest.mark.parametrize(("arguments", "told"), [({}, []), ({"learning_starts": 7}, [7])])
def test_who_chose_the_first_update_is_told_that_it_is_raised(
    arguments: dict[str, Any], told: list[int], make_env: Any, caplog: pytest.LogCaptureFixture
) -> None:
    env = make_env("TinyReach-v0", 8)
    arguments = {"policy": "auto", "replay_buffer_class": "auto", "buffer_size": 500} | arguments
    with caplog.at_level("INFO"):
        model = build_algorithm(SAC, arguments, env, seed=1, device="cpu")
    assert model.learning_starts == 128  # an episode of 15 steps and one step in each
    assert [r.args[0] for r in caplog.records if r.msg.startswith("learning_starts")] == told
