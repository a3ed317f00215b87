"""MyoSuite has a virtual environment of its own: make test-myosuite."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import pytest

from scilab_rl.envs import registration
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import MissingDependencyError
from scilab_rl.testing.goal_environments import EnvironmentContract

ROOT = Path(__file__).parents[4]


def test_missing_package_names_the_constraints(monkeypatch) -> None:
    monkeypatch.setattr(registration.Suite, "installed", False)
    line = r'pip install -c constraints-myosuite.txt "scilab-rl\[myosuite\]"'
    with pytest.raises(MissingDependencyError, match=line):
        resolve_env_id("myoFingerReach-v9")


def test_its_versions_fit_ours() -> None:
    pinned = (ROOT / "constraints-myosuite.txt").read_text(encoding="utf-8").splitlines()
    versions = dict(line.split("==") for line in pinned if "==" in line)
    assert versions["torch"] == "2.13.0"
    assert versions["gymnasium"].startswith("1.2.")
    assert versions["mujoco"].startswith("3.6.")


class MyoSuite(EnvironmentContract):
    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        pytest.importorskip("myosuite", reason="needs MyoSuite: make test-myosuite")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of MyoSuite's own dependencies
class TestElbow(MyoSuite):
    env = "myoElbowPose1D6MRandom-v0"
    n_steps = 300

    def test_success_is_what_myosuite_calls_solved(self) -> None:
        env = gym.make(resolve_env_id(self.env)[0])
        env.reset(seed=0)
        told = set()
        for _ in range(300):
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            assert info["is_success"] == bool(info["solved"])
            told.add(info["is_success"])
            if terminated or truncated:
                env.reset()
        assert told == {True, False}


class TestFinger(MyoSuite):
    env = "myoFingerReachRandom-v0"
    n_steps = 300


class TestHand(MyoSuite):
    env = "myoHandReachRandom-v0"
    n_steps = 100


class TestFetchThere(MyoSuite):
    """Our own tasks are the same with the MuJoCo that MyoSuite needs."""

    env = "FetchReach-v4"
    n_steps = 100
