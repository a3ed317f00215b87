from __future__ import annotations

import itertools
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from scilab_rl.envs.vec_step import VecStep
from scilab_rl.learning.off_policy import OffPolicyAlgorithm

from .test_base import Diary, countdown


class Probe(OffPolicyAlgorithm):
    """Acts at random, remembers what it saw, and counts its updates."""

    supported_action_spaces: ClassVar = (spaces.Box, spaces.Discrete)

    def __init__(self, *, env: Any, her: bool = False, **kwargs: Any) -> None:
        kwargs = {"learning_starts": 10**6} | kwargs
        kind = HerReplayBuffer if her else None
        super().__init__(
            env=env, buffer_size=100, replay_buffer_class=kind, seed=3, device="cpu", **kwargs
        )
        self.steps: list[VecStep] = []
        self.make_replay_buffer()

    def store(self, step: VecStep, actions: np.ndarray) -> None:
        super().store(step, actions)
        self.steps.append(step)

    def act(self, observations: torch.Tensor, deterministic: bool) -> torch.Tensor:
        return torch.full((len(observations), self.n_actions), 2.0)

    def action_values(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return torch.stack([observations[:, 0], actions[:, 0]], dim=1)

    def update(self, batch: ReplayBufferSamples) -> dict[str, torch.Tensor]:
        return {"loss": batch.rewards.sum(), "update": torch.tensor(float(self.n_updates))}


@pytest.mark.parametrize("terminates", [True, False])
def test_only_a_terminal_state_has_no_future(terminates: bool) -> None:
    model = Probe(env=countdown(terminates))
    model.learn(4)
    buffer = model.replay_buffer
    assert buffer is not None
    assert buffer.next_observations[:4, 0, 0].tolist() == [1.0, 2.0, 3.0, 1.0]
    dones = buffer._get_samples(np.arange(4)).dones.flatten().tolist()
    assert dones == [0.0, 0.0, float(terminates), 0.0]


@pytest.mark.parametrize(("gradient_steps", "n_updates"), [(2, 4), (-1, 10), (0, 0)])
def test_rounds_of_updates_follow_rounds_of_steps(gradient_steps: int, n_updates: int) -> None:
    model = Probe(
        env=countdown(True), learning_starts=5, train_freq=5, gradient_steps=gradient_steps
    )
    model.learn(15)  # three rounds, the first of which ends when learning starts
    assert model.n_updates == n_updates


def test_the_mean_over_a_round_is_recorded_and_each_update_has_its_batch() -> None:
    model = Probe(env=countdown(True), learning_starts=5, train_freq=3, gradient_steps=3)
    model.batch_size = 7
    model.learn(6)
    values = model.logger.take()
    assert values["train/loss"] == 7.0  # rewards of 1
    assert values["train/update"] == 1.0  # the mean of 0, 1 and 2


def test_actions_are_random_until_learning_starts() -> None:
    model = Probe(env=countdown(True), learning_starts=4, gradient_steps=0)
    model.learn(8)
    assert model.replay_buffer is not None
    actions = model.replay_buffer.actions[:8, 0]
    assert (np.abs(actions[:4]) <= 1).all()
    assert (actions[4:] == 2.0).all()


def test_what_critics_think_of_steps_is_asked_in_the_algorithms_units() -> None:
    model = Probe(env=countdown(True))
    observations, env_actions = np.float32([[3.0]]), np.float32([[3.0, 10.0]])  # the upper bounds
    assert model.q_values(observations, env_actions).tolist() == [[3.0, 1.0]]
    model.record_step(observations, env_actions)
    assert model.logger.take() == {"train/rollout_q_step": 1.0}  # the smallest critic's


def test_an_intrinsic_reward_is_mixed_into_each_batch() -> None:
    class Doubled:
        def apply(self, batch: ReplayBufferSamples) -> ReplayBufferSamples:
            return batch._replace(rewards=2 * batch.rewards)

    model = Probe(env=countdown(True))
    model.learn(5)
    model.intrinsic = Doubled()
    assert model.sample(3).rewards.tolist() == [[2.0]] * 3


def test_normalised_environments_are_stored_as_they_were() -> None:
    env = VecNormalize(countdown(False), clip_obs=5.0)
    model = Probe(env=env)
    model.learn(5)
    buffer = model.replay_buffer
    assert buffer is not None
    assert buffer.observations[:5, 0, 0].tolist() == [0.0, 1.0, 2.0, 0.0, 1.0]
    np.testing.assert_allclose(buffer.next_observations[:5, 0, 0], [1, 2, 3, 1, 2], rtol=1e-5)
    assert buffer.rewards[:5, 0].tolist() == [1.0] * 5
    expected = env.normalize_obs(np.float32([[2.0]]))
    indices = model.sample(50).observations
    assert any(np.isclose(float(row), expected[0, 0]) for row in indices.flatten())


def test_a_reset_closes_the_episodes_that_hindsight_replay_was_recording(make_env: Any) -> None:
    model = Probe(env=make_env("TinyReach-v0"), her=True)
    model.learn(4)
    model.learn(3)
    buffer = model.replay_buffer
    assert isinstance(buffer, HerReplayBuffer)
    assert buffer.ep_length[:7, 0].tolist() == [4, 4, 4, 4, 0, 0, 0]
    assert buffer.timeouts[3, 0] == 1.0  # cut off, not terminal


@pytest.mark.parametrize("stop_after", [4, 15])
def test_learning_goes_on_after_a_stop_where_the_environment_is(
    make_env: Any, stop_after: int
) -> None:
    env = make_env("TinyReach-v0")  # 15 steps per episode
    model = Probe(env=env, her=True)
    model.learn(100, callback=Diary(stop_after))
    model.learn(20, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert isinstance(buffer, HerReplayBuffer)
    for before, after in itertools.pairwise(model.steps[stop_after - 1 :]):
        if not before.dones[0]:
            assert after.observations["observation"].tolist() == (
                before.next_observations["observation"].tolist()
            )
    # The forgotten step divides the recorded episode, so that each part has goals of its own.
    assert buffer.ep_length[: stop_after - 1, 0].tolist() == [stop_after - 1] * (stop_after - 1)
    second = 15 if stop_after == 15 else 15 - stop_after
    assert buffer.ep_length[stop_after - 1, 0] == second
