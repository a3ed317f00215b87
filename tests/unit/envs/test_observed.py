import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.vectorize import make_train_env, observed_layer
from scilab_rl.errors import EnvironmentFailure, NumericalError
from scilab_rl.metrics.success import success_of
from scilab_rl.testing.environments import TinyReach

BAD = [float("nan"), float("inf"), float("-inf")]


class Faulty(TinyReach):
    """Does something wrong at one call."""

    def __init__(self, place, value=None, at_step=3):
        super().__init__()
        self.place, self.value, self.at_step, self.n_steps = place, value, at_step, 0

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        if self.place == "raise in reset":
            raise ValueError("no floor\nunder the robot")
        return self._spoiled(observation) if self.at_step == 0 else observation, info

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        if self.n_steps == self.at_step:
            if self.place == "raise in step":
                raise ValueError("the gripper broke")
            if self.place == "reward":
                reward = self.value
            observation = self._spoiled(observation)
            terminated = self.place == "last observation"
        return observation, reward, terminated, truncated, info

    def _spoiled(self, observation):
        if self.place in observation:
            observation[self.place][1] = self.value
        if self.place == "last observation":
            observation["observation"][1] = self.value
        return observation


def observed(*arguments, n_envs=2, **keywords):
    makers = [TinyReach] * (n_envs - 1) + [lambda: Faulty(*arguments, **keywords)]
    return ObservedVecEnv(DummyVecEnv(makers), "train", "Tiny")


def act(env, n):
    env.reset()
    for _ in range(n):
        env.step(np.full((env.num_envs, 2), 0.5, np.float32))


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("key", ["observation", "achieved_goal", "desired_goal"])
@pytest.mark.parametrize("at_step", [0, 1, 3])
def test_an_observation_that_is_no_number_is_refused(key, value, at_step):
    env, seen = observed(key, value, at_step=at_step), []
    env.observers.append(Collecting(seen))
    with pytest.raises(EnvironmentFailure) as error:
        act(env, 5)
    message = str(error.value)
    assert message.startswith(
        f"Tiny: observation '{key}' is {value} at index (1,) of environment 1"
    )
    assert ("last action [0.5 0.5]" if at_step else "last action None") in message
    assert f"after step {2 * max(at_step - 1, 0)};" in message
    assert len(seen) == max(at_step - 1, 0)  # the spoiled step reaches nobody


@pytest.mark.parametrize("value", BAD)
def test_a_reward_that_is_no_number_is_refused(value):
    env = observed("reward", value)
    with pytest.raises(
        EnvironmentFailure, match=r"Tiny: reward is .* of environment 1 after step 4"
    ):
        act(env, 5)


@pytest.mark.parametrize("value", BAD)
def test_the_last_observation_of_an_episode_is_checked_too(value):
    with pytest.raises(EnvironmentFailure, match="observation 'observation' is"):
        act(observed("last observation", value), 5)


@pytest.mark.parametrize("value", BAD)
def test_an_action_that_is_no_number_never_reaches_the_simulator(value):
    env = observed("nothing")
    env.reset()
    with pytest.raises(NumericalError, match=r"The agent's action is .* at train step 0"):
        env.step(np.array([[0.0, value], [0.0, 0.0]], np.float32))


@pytest.mark.parametrize("call", ["reset", "step"])
def test_what_an_environment_raises_is_named(call):
    env = observed(f"raise in {call}")
    with pytest.raises(EnvironmentFailure, match=rf"Tiny raised ValueError in {call}\(\) at train"):
        act(env, 5)


def test_errors_of_the_framework_pass_as_they_are():
    class Broken(TinyReach):
        def step(self, action):
            raise EnvironmentFailure("mine")

    env = ObservedVecEnv(DummyVecEnv([Broken]), "train", "Tiny")
    with pytest.raises(EnvironmentFailure, match=r"^mine$"):
        act(env, 1)


class Collecting:
    def __init__(self, batches):
        self.batches = batches

    def on_step(self, batch):
        self.batches.append(batch)


def observed_tiny(env_id="TinyPixels-v0", n_envs=1):
    env = make_train_env(RunConfig(f"scilab_rl.testing:{env_id}", n_envs=n_envs, seed=1))
    batches = []
    observed_layer(env).observers.append(Collecting(batches))
    return env, batches


def test_observers_see_every_step_with_its_number_and_episode():
    env, batches = observed_tiny(n_envs=2)
    env.reset()
    for _ in range(25):
        env.step(np.zeros((2, 1), np.float32))
    assert [batch.step for batch in batches] == list(range(2, 52, 2))
    assert {batch.phase for batch in batches} == {"train"}
    assert [batch.episodes.tolist() for batch in batches] == [[i // 10] * 2 for i in range(25)]
    assert [batch.episode_steps.tolist() for batch in batches] == [[i % 10] * 2 for i in range(25)]
    for i, batch in enumerate(batches):
        episode, step = divmod(i, 10)
        # before the action, the reward for it, and after it
        assert batch.observations[0].tolist() == [episode, step]
        assert batch.rewards[0] == pytest.approx(episode + (step + 1) / 100)
        after = [episode + 1, 0] if step == 9 else [episode, step + 1]
        assert batch.next_observations[0].tolist() == [episode, step + 1]
        assert batch.reset_observations[0].tolist() == after
        assert batch.dones.tolist() == batch.truncated.tolist() == [step == 9] * 2
        assert not batch.terminated.any()


def test_a_reset_drops_the_running_episode():
    env, batches = observed_tiny()
    env.reset()
    env.step(np.zeros((1, 1)))
    env.reset()
    env.step(np.zeros((1, 1)))
    assert [batch.episode_steps[0] for batch in batches] == [0, 0]


def test_counters_go_on_from_a_checkpoint():
    env, _ = observed_tiny("TinyReach-v0", n_envs=2)
    env.reset()
    for _ in range(20):
        env.step(np.zeros((2, 2), np.float32))
    state = observed_layer(env).state()
    other, batches = observed_tiny("TinyReach-v0", n_envs=2)
    other.reset()
    observed_layer(other).continue_from(state)
    other.step(np.zeros((2, 2), np.float32))
    assert batches[0].step == 42
    assert batches[0].episodes.tolist() == [1, 1]
    assert batches[0].episode_steps.tolist() == [5, 5]
    assert np.array_equal(
        batches[0].observations["desired_goal"], state["observations"]["desired_goal"]
    )


def test_whole_numbers_are_always_finite():
    class Counting(gym.Env):
        action_space = spaces.Discrete(2)
        observation_space = spaces.Discrete(5)

        def reset(self, *, seed=None, options=None):
            return 3, {}

        def step(self, action):
            return 4, 0.0, False, False, {}

    env = ObservedVecEnv(DummyVecEnv([Counting]), "train", "Counting")
    env.reset()
    assert env.step(np.array([1]))[0].tolist() == [4]


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        ({"is_success": True}, True),
        ({"is_success": 0.0}, False),
        ({"success": 1}, True),
        ({"is_success": False, "success": True}, False),
        ({}, None),
    ],
)
def test_success_is_read_from_the_usual_places(info, expected):
    assert success_of(info) is expected
