"""MuJoCo resets an unstable simulation silently; here that ends the episode and is counted."""

from __future__ import annotations

import logging
from collections import deque

import gymnasium as gym
import numpy as np

from scilab_rl.envs.frames import simulator_state
from scilab_rl.envs.types import Info, ResetResult, StepResult

_log = logging.getLogger(__name__)
UNSTABLE_KEY = "simulation_unstable"
STATES_KEY = "scilab_rl.states_before_instability"
N_STATES = 100
# mjWARN_BADQPOS, mjWARN_BADQVEL and mjWARN_BADQACC: those after which MuJoCo resets itself.
_RESETTING = slice(4, 7)


class StabilityGuard(gym.Wrapper):
    """Truncates an episode in which the simulation became unstable.

    Without it the robot is suddenly back at its start, in the middle of an episode, and the agent
    learns from that. The info of such a step holds `UNSTABLE_KEY` and, under `STATES_KEY`, the
    simulator's last states before it, at most 100, the oldest first (see `frames`).

    Args:
        env: An environment with MuJoCo's ``data``.

    Attributes:
        n_unstable: How often it happened.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.n_unstable = 0
        # A view of MuJoCo's own counters.
        self._warnings = env.unwrapped.data.warning.number[_RESETTING]  # type: ignore[attr-defined]
        self._seen = 0
        self._states: deque[np.ndarray | None] = deque(maxlen=N_STATES)
        _keep_warnings_out_of_the_folder()

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin an episode."""
        result = self.env.reset(seed=seed, options=options)
        self._seen = self._count()
        self._states.clear()
        return result

    def step(self, action: np.ndarray) -> StepResult:
        """Act, and look whether the simulation has reset itself meanwhile."""
        self._states.append(simulator_state(self.env))  # before the step: after it, it is reset
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._count() > self._seen:
            self._seen = self._count()
            self.n_unstable += 1
            states = np.array(self._states)
            truncated, info = True, {**info, UNSTABLE_KEY: True, STATES_KEY: states}
            if self.n_unstable == 1:
                _log.warning(
                    "The simulation became unstable and MuJoCo reset it; such episodes are "
                    "truncated. Often a smaller timestep or weaker forces help."
                )
        return observation, reward, terminated, truncated, info

    def _count(self) -> int:
        return int(self._warnings.sum())


def guard(env: gym.Env) -> gym.Env:
    """Wrap an environment whose simulator is MuJoCo, once; return others as they are."""
    guarded = env.has_wrapper_attr("n_unstable") or simulator_state(env) is None
    return env if guarded else StabilityGuard(env)


def _keep_warnings_out_of_the_folder() -> None:
    """Send MuJoCo's warnings to the log instead of ``MUJOCO_LOG.TXT`` in the current folder."""
    import mujoco

    mujoco.set_mju_user_warning(_log.debug)
