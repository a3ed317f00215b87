from __future__ import annotations

import itertools
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.canonical_spaces import with_canonical_spaces
from scilab_rl.errors import ConfigError, NumericalError
from scilab_rl.learning.base import LazyNumber, OneFileAlgorithm
from scilab_rl.learning.finite import check_finite, check_finite_weights
from scilab_rl.learning.observations import to_vector
from scilab_rl.metrics.logger import MetricLogger

CPU = torch.device("cpu")


class Probe(OneFileAlgorithm):
    """Does nothing but act and remember what it saw."""

    supported_action_spaces: ClassVar = (spaces.Box, spaces.Discrete)

    def __init__(self, *, env: Any, seed: int | None = 3) -> None:
        super().__init__(env=env, seed=seed, device="cpu")
        self.steps: list[Any] = []

    def iterate(self, callback: BaseCallback) -> bool:
        callback.on_rollout_start()
        actions = self.sample_env_actions()
        step = self.step(actions, callback)
        if step is None:
            return False
        self.steps.append(step)
        callback.on_rollout_end()
        return True

    def act(self, observations: torch.Tensor, deterministic: bool) -> torch.Tensor:
        return torch.full((len(observations), self.n_actions), 2.0)


class Diary(BaseCallback):
    def __init__(self, stop_after: int = 10**9) -> None:
        super().__init__()
        self.calls: list[str] = []
        self.stop_after = stop_after

    def _on_training_start(self) -> None:
        self.calls.append("training_start")

    def _on_rollout_start(self) -> None:
        self.calls.append("rollout_start")

    def _on_step(self) -> bool:
        self.calls.append("step")
        return self.n_calls < self.stop_after

    def _on_rollout_end(self) -> None:
        self.calls.append("rollout_end")

    def _on_training_end(self) -> None:
        self.calls.append("training_end")


class Countdown(gym.Env):
    """Ends by itself in step 3 when ``terminates``; the observation is the number of the step."""

    observation_space = spaces.Box(-10.0, 100.0, (1,), np.float32)
    action_space = spaces.Box(np.float32([-1.0, 0.0]), np.float32([3.0, 10.0]))

    def __init__(self, terminates: bool) -> None:
        self.terminates = terminates

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.count = 0
        return np.float32([0.0]), {}

    def step(self, action: Any) -> Any:
        self.count += 1
        ended = self.count == 3
        observation = np.float32([self.count])
        return observation, 1.0, ended and self.terminates, ended and not self.terminates, {}


def countdown(terminates: bool) -> DummyVecEnv:
    return DummyVecEnv([lambda: Countdown(terminates)])


def test_callbacks_come_in_the_order_of_stable_baselines3() -> None:
    diary = Diary()
    Probe(env=countdown(True)).learn(2, callback=diary)
    iteration = ["rollout_start", "step", "rollout_end"]
    assert diary.calls == ["training_start", *iteration, *iteration, "training_end"]


def test_a_callback_that_returns_false_stops_at_once() -> None:
    model = Probe(env=countdown(True))
    diary = Diary(stop_after=2)
    model.learn(100, callback=[diary])
    assert model.num_timesteps == 2
    assert diary.calls[-2:] == ["step", "training_end"]


def test_a_plain_function_serves_as_callback() -> None:
    seen: list[float] = []

    def watch(local_variables: dict[str, Any], _: Any) -> bool:
        seen.append(float(local_variables["rewards"][0]))
        return len(seen) < 3

    Probe(env=countdown(True)).learn(10, callback=watch)
    assert seen == [1.0, 1.0, 1.0]


def test_learn_continues_without_reset() -> None:
    model = Probe(env=countdown(True))
    model.learn(2)
    model.learn(2, reset_num_timesteps=False)
    assert model.num_timesteps == 4
    seen = [float(step.observations[0, 0]) for step in model.steps]
    assert seen == [0.0, 1.0, 2.0, 0.0]  # the episode of three steps went on

    model.learn(1)
    assert model.num_timesteps == 1
    assert float(model.steps[-1].observations[0, 0]) == 0.0


@pytest.mark.parametrize("terminates", [True, False])
def test_the_end_of_an_episode_leads_to_its_own_last_state(terminates: bool) -> None:
    model = Probe(env=countdown(terminates))
    model.learn(4)
    last = model.steps[2]
    assert last.dones.tolist() == [True]
    assert last.terminated.tolist() == [terminates]
    assert last.next_observations.tolist() == [[3.0]]
    assert model.steps[3].observations.tolist() == [[0.0]]


def test_actions_are_scaled_between_the_bounds() -> None:
    model = Probe(env=countdown(True))
    ours = np.float32([[-1.0, -1.0], [0.0, 0.0], [1.0, 0.5]])
    theirs = model.to_env_actions(torch.as_tensor(ours))
    np.testing.assert_allclose(theirs, [[-1.0, 0.0], [1.0, 5.0], [3.0, 7.5]])
    assert theirs.dtype == np.float32
    np.testing.assert_allclose(model.from_env_actions(theirs), ours, atol=1e-6)
    assert model.to_env_actions(torch.tensor([[9.0, -9.0]])).tolist() == [[3.0, 0.0]]


def test_discrete_actions_start_where_the_space_starts() -> None:
    class FromTwo(Countdown):
        action_space = spaces.Discrete(3, start=2)

        def step(self, action: Any) -> Any:
            return *super().step(action)[:4], {"action": action}

    bare = DummyVecEnv([lambda: FromTwo(True)])
    with pytest.raises(ConfigError, match="with_canonical_spaces"):
        Probe(env=bare)  # it would send 0
    model = Probe(env=with_canonical_spaces(bare))
    assert model.to_env_actions(torch.tensor([0, 2])).tolist() == [0, 2]
    assert model.from_env_actions(np.array([0, 2])).tolist() == [[0], [2]]
    assert model.n_actions == 3
    model.learn(20)
    assert {int(step.infos[0]["action"]) for step in model.steps} == {2, 3, 4}


def test_predict_has_the_signature_of_stable_baselines3() -> None:
    model = Probe(env=countdown(True))
    single, state = model.predict(np.float32([1.0]), state="kept", deterministic=True)
    assert single.tolist() == [3.0, 10.0]
    assert state == "kept"
    batch, _ = model.predict(np.float32([[1.0], [2.0]]), episode_start=np.ones(2, dtype=bool))
    assert batch.shape == (2, 2)
    with pytest.raises(ValueError, match="shape"):
        model.predict(np.zeros((1, 4), np.float32))


def test_predict_takes_dictionaries_with_and_without_batch(make_env: Any) -> None:
    env = make_env("TinyReach-v0", 2)
    model = Probe(env=env)
    observations = env.reset()
    assert model.predict(observations)[0].shape == (2, 2)
    single = {key: value[0] for key, value in observations.items()}
    assert model.predict(single)[0].shape == (2,)


def test_an_action_that_is_no_number_is_refused() -> None:
    model = Probe(env=countdown(True))
    with pytest.raises(NumericalError, match=r"action of the policy is .*nan"):
        model.to_env_actions(torch.tensor([[float("nan"), 0.0]]))


def test_action_spaces_that_are_not_supported_are_refused() -> None:
    class OnlyDiscrete(Probe):
        supported_action_spaces = (spaces.Discrete,)

    with pytest.raises(ConfigError, match=r"OnlyDiscrete needs Discrete actions, .* has Box"):
        OnlyDiscrete(env=countdown(True))


def test_a_seed_determines_environment_and_exploration(make_env: Any) -> None:
    def run(seed: int) -> list[float]:
        model = Probe(env=make_env("TinyBox-v0", 2), seed=seed)
        model.learn(20)
        return [float(x) for step in model.steps for x in step.next_observations.flatten()]

    assert run(1) == run(1)
    assert run(1) != run(2)


SPACES = [
    # Three dimensions of bytes from 0 to 255 are an image, as for Stable-Baselines3.
    (spaces.Box(0, 255, (1, 2, 2), np.uint8), [[[[0, 255], [51, 0]]]], [[0.0, 1.0, 0.2, 0.0]]),
    (spaces.Box(0, 255, (2, 2), np.uint8), [[[0, 255], [51, 0]]], [[0.0, 255.0, 51.0, 0.0]]),
    (spaces.Box(0, 1, (4,), np.uint8), [[0, 1, 1, 0]], [[0.0, 1.0, 1.0, 0.0]]),
    (spaces.Box(0, 1, (1, 2, 2), np.uint8), [[[[0, 1], [1, 0]]]], [[0.0, 1.0, 1.0, 0.0]]),
    (spaces.Discrete(3), [0, 2], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    (spaces.MultiDiscrete([2, 3]), [[1, 0]], [[0.0, 1.0, 1.0, 0.0, 0.0]]),
    (spaces.MultiBinary(3), [[1, 0, 1]], [[1.0, 0.0, 1.0]]),
    (
        spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Box(-1, 1, (2,))}),
        {"a": [[0.5, -0.5]], "b": [1]},
        [[0.5, -0.5, 0.0, 1.0]],
    ),
]


@pytest.mark.parametrize(("space", "values", "expected"), SPACES)
def test_observations_become_vectors(space: spaces.Space, values: Any, expected: Any) -> None:
    if isinstance(values, dict):
        values = {key: np.array(entry) for key, entry in values.items()}
    vector = to_vector(values if isinstance(values, dict) else np.array(values), space, CPU)
    np.testing.assert_allclose(vector.numpy(), expected)
    assert vector.shape[1] == spaces.flatdim(space)


@pytest.mark.parametrize(("bad", "word"), [(float("nan"), "nan"), (float("-inf"), "-inf")])
def test_a_loss_that_is_no_number_is_named_with_its_update(bad: float, word: str) -> None:
    losses = torch.tensor([0.1, bad, 0.3])
    with pytest.raises(NumericalError) as caught:
        check_finite("critic_loss", losses, update=12, learning_rate=0.1, gamma=0.9)
    assert str(caught.value).startswith(
        f"critic_loss is {word} at update 11 (learning_rate=0.1, gamma=0.9)."
    )


def test_large_losses_are_still_numbers() -> None:
    check_finite("loss", torch.full((3,), 3e38), update=3)


def test_large_weights_are_still_numbers() -> None:
    network = torch.nn.Linear(3, 2)
    torch.nn.init.constant_(network.weight, 3e38)  # the sum overflows
    check_finite_weights("actor", network, update=1)


def test_a_weight_that_is_no_number_is_named() -> None:
    network = torch.nn.Linear(2, 1)
    check_finite_weights("actor", network, update=5)
    with torch.no_grad():
        network.weight[0, 1] = float("inf")
    with pytest.raises(NumericalError, match=r"actor\.weight is inf at update 5 \(gamma=0.9\)"):
        check_finite_weights("actor", network, update=5, gamma=0.9)


def test_lazy_numbers_are_computed_when_they_are_looked_at() -> None:
    computed = itertools.count()
    logger = MetricLogger()
    for _ in range(5):
        logger.record("train/rollout_q_step", LazyNumber(lambda: next(computed)))
    assert logger.take() == {"train/rollout_q_step": 0.0}
