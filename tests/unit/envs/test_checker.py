"""The doctor is tested: it must find each fault that is put into a sound environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from scilab_rl.envs.checker import check_environment
from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.run_env import RunEnv


class Sound(GoalEnv):
    """A point on a line that moves by a tenth of the action."""

    action_size = 1
    threshold = 0.1

    def reset_state(self) -> None:
        self.place = np.zeros(1)

    def sample_goal(self) -> np.ndarray:
        return self.np_random.choice([-1, 1]) * self.np_random.uniform(0.15, 0.5, 1)

    def apply_action(self, action: np.ndarray) -> None:
        self.place = self.place + 0.1 * action

    def achieved_goal(self) -> np.ndarray:
        return self.place

    def get_observation(self) -> np.ndarray:
        return self.place


class OneRewardForAll(Sound):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return -float(np.linalg.norm(achieved_goal - desired_goal) > 0.1)


class OtherReward(Sound):
    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, reward - 0.5, *rest


class TwoThresholds(Sound):
    def _is_success(self, observation):
        distance = self.distance(observation["achieved_goal"], observation["desired_goal"])
        return bool(distance <= 0.05)


class SilentSuccess(Sound):
    def step(self, action):
        *result, _ = super().step(action)
        return *result, {}


class SameGoal(Sound):
    def sample_goal(self) -> np.ndarray:
        return np.array([0.3])


class SharedGoal(Sound):
    def _observation(self):
        return {**super()._observation(), "desired_goal": self.goal}


class ForeignDice(Sound):
    def sample_goal(self) -> np.ndarray:
        return np.random.default_rng().uniform(0.15, 0.5, 1)


class Deaf(Sound):
    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        return super().reset(seed=0, options=options)


class Memory(Sound):
    """Its start depends on the episodes before."""

    n_resets = 0

    def reset_state(self) -> None:
        self.n_resets += 1
        self.place = np.array([0.001 * self.n_resets])


class Forgetful(Sound):
    def __init__(self, threshold: float = 0.1, start: float = 0.0) -> None:
        self.start = start
        super().__init__(threshold=threshold)

    def reset_state(self) -> None:
        self.place = np.array([self.start])

    def __reduce__(self):
        return type(self), ()


class EndsAlone(Sound):
    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, bool(info["is_success"]), truncated, info


class AlreadyThere(Sound):
    def sample_goal(self) -> np.ndarray:
        return self.np_random.uniform(-0.09, 0.09, 1)


class WrongShape(Sound):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space["observation"] = gym.spaces.Box(-1, 1, (2,))


class Breaks(Sound):
    def apply_action(self, action: np.ndarray) -> None:
        raise RuntimeError("motor off")


class RandomPicture(Sound):
    def render(self) -> np.ndarray:
        return self.np_random.integers(0, 255, (8, 8, 3)).astype(np.uint8)


class NoPicture(Sound):
    def render(self) -> None:
        return None


def diagnose(cls: type, *arguments) -> dict[str, Any]:
    make = lambda: TimeLimit(cls(*arguments), 20)  # noqa: E731
    found = check_environment(make, n_steps=300, make_drawn=lambda: RunEnv(make()))
    return {finding.check: finding for finding in found}


def test_a_sound_environment_is_found_sound() -> None:
    found = diagnose(Sound)
    assert {finding.result for finding in found.values()} == {"ok", "info"}
    assert len(found) == 17
    assert found["success of random actions"].found.endswith("of 15 episodes")


@pytest.mark.parametrize(
    ("cls", "check", "result", "words"),
    [
        (OneRewardForAll, "rewards of a batch", "warn", "answers for one goal at a time"),
        (OtherReward, "rewards of a batch", "fail", "300 of 300 differ"),
        (TwoThresholds, "reward and success", "fail", "a failure gets the same reward"),
        (SilentSuccess, "reward and success", "fail", "info does not report success"),
        (SameGoal, "new goals", "fail", "1 different goals in 30 resets"),
        (SharedGoal, "copies", "fail", "desired_goal of an earlier observation is not a copy"),
        (ForeignDice, "seeds", "fail", "a second episode with the same seed"),
        (Deaf, "seeds", "warn", "another seed gives the same episode"),
        (Memory, "resume", "warn", "leads elsewhere"),
        (EndsAlone, "endings of relabeled goals", "fail", "compute_terminated differs"),
        (AlreadyThere, "trivial goals", "warn", "100% of"),
        (WrongShape, "goals", "fail", "300 observations are outside"),
        (RandomPicture, "pictures", "fail", "an episode that is drawn is another one"),
        (Breaks, "random steps", "fail", "RuntimeError: motor off"),
    ],
)
def test_each_fault_is_found(cls, check, result, words) -> None:
    finding = diagnose(cls)[check]
    assert finding.result == result, finding
    assert words in finding.found
    assert finding.fix


def test_what_cannot_be_drawn_is_told() -> None:
    finding = diagnose(NoPicture)["pictures"]
    assert (finding.result, finding.found) == ("info", "none: render() returned None")


def test_lost_arguments_are_found() -> None:
    finding = diagnose(Forgetful, 0.1, 0.05)["pickling"]
    assert (finding.result, finding.found) == ("fail", "a copy begins another episode")


def test_endless_episodes_are_found() -> None:
    found = {finding.check: finding for finding in check_environment(Sound, n_steps=50)}
    assert found["endings"].result == "warn"
    assert "max_episode_steps" in found["endings"].fix


def test_another_fingerprint_is_found() -> None:
    make = lambda: TimeLimit(Sound(), 20)  # noqa: E731
    found = {f.check: f for f in check_environment(make, n_steps=50, known_fingerprints=["0" * 16])}
    assert found["fingerprint"].result == "warn"
    right = found["fingerprint"].found.partition(",")[0]
    found = {f.check: f for f in check_environment(make, n_steps=50, known_fingerprints=[right])}
    assert found["fingerprint"].result == "ok"
