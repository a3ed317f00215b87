from __future__ import annotations

import logging

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.envs.blocks import Blocks
from scilab_rl.envs.checker import check_environment
from scilab_rl.envs.frames import simulator_state
from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.stability import STATES_KEY, UNSTABLE_KEY, StabilityGuard, guard
from scilab_rl.training.instability import InstabilityRecord


class Exploding(Blocks):
    """At its third step the block is shot away at 10^12 m/s."""

    def reset_state(self) -> None:
        self.n_steps = 0
        super().reset_state()

    def apply_action(self, action: np.ndarray) -> None:
        self.n_steps += 1
        if self.n_steps == 3:
            self.data.qvel[-3] = 1e12
        super().apply_action(action)


def test_f11_silent_reset_ends_the_episode_and_is_counted(tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.chdir(tmp_path)
    env = guard(Exploding())
    assert isinstance(env, StabilityGuard)
    assert guard(env) is env
    with caplog.at_level(logging.WARNING):
        for n_unstable in (1, 2):
            env.reset(seed=0)
            endings = []
            for _ in range(3):
                truncated, info = env.step(np.zeros(4))[3:]
                endings.append((truncated, UNSTABLE_KEY in info))
            assert endings == [(False, False), (False, False), (True, True)]
            assert env.n_unstable == n_unstable
    assert [record.message[:25] for record in caplog.records] == ["The simulation became uns"]
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


def test_f11_the_states_that_led_to_it_are_kept() -> None:
    env = guard(Exploding())
    for _ in range(2):  # the states of an earlier episode do not count
        env.reset(seed=0)
        states = []
        for _ in range(3):
            states.append(simulator_state(env))
            info = env.step(np.zeros(4))[4]
        assert np.array_equal(info[STATES_KEY], states)


def test_f11_a_run_counts_unstable_episodes_and_writes_what_led_to_them(tmp_path) -> None:
    record = InstabilityRecord(tmp_path / "unstable")
    venv = ObservedVecEnv(DummyVecEnv([lambda: guard(Exploding())] * 2), "train", "Exploding")
    venv.observers.append(record)
    venv.seed(0)
    venv.reset()
    assert record.metrics() == {}
    for _ in range(3):
        infos = venv.step(np.zeros((2, 4)))[3]
    assert record.metrics() == {"env/unstable_episodes": 2.0}
    files = sorted((tmp_path / "unstable").iterdir())
    assert [file.name for file in files] == ["step-000006-env0.npy", "step-000006-env1.npy"]
    assert len(np.load(files[0], allow_pickle=False)) == 3
    assert STATES_KEY not in infos[0]


def test_other_simulators_are_left_alone() -> None:
    class Dot(GoalEnv):
        action_size = 1
        reset_state = apply_action = lambda self, *_: None
        sample_goal = achieved_goal = get_observation = lambda self: np.zeros(1)

    env = Dot()
    assert guard(env) is env


def test_the_doctor_counts_it() -> None:
    found = {finding.check: finding for finding in check_environment(Exploding, n_steps=12)}
    assert found["stability"].result == "warn"
    assert "unstable 4 times" in found["stability"].found
