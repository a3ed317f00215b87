from __future__ import annotations

import logging

import numpy as np

from scilab_rl.envs.blocks import Blocks
from scilab_rl.envs.examination import examine
from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.stability import UNSTABLE_KEY, StabilityGuard, guard


class Exploding(Blocks):
    """At its third step the block is shot away at 10^12 m/s."""

    def restart(self) -> None:
        self.n_steps = 0
        super().restart()

    def apply(self, action: np.ndarray) -> None:
        self.n_steps += 1
        if self.n_steps == 3:
            self.data.qvel[-3] = 1e12
        super().apply(action)


def test_silent_reset_ends_the_episode_and_is_counted(tmp_path, monkeypatch, caplog) -> None:
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


def test_other_simulators_are_left_alone() -> None:
    class Dot(GoalEnv):
        action_size = 1
        restart = apply = lambda self, *_: None
        sample_goal = achieved_goal = observe = lambda self: np.zeros(1)

    env = Dot()
    assert guard(env) is env


def test_the_doctor_counts_it() -> None:
    found = {finding.check: finding for finding in examine(Exploding, n_steps=12)}
    assert found["stability"].result == "warn"
    assert "unstable 4 times" in found["stability"].found
