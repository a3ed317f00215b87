"""panda-gym's tasks, whose episodes depend on their seed alone.

PyBullet keeps more than poses and speeds from one episode to the next, and neither a reset nor its
saved states take that back: the same seed gave another episode after another one (0.8 cm apart
after 20 steps of pushing). Here each reset rebuilds the world, in the same PyBullet. And
panda-gym draws unseeded goals from the operating system; here they follow from the last seed.
"""

from __future__ import annotations

import functools
from unittest import mock

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from panda_gym.envs import panda_tasks
from panda_gym.envs.core import RobotTaskEnv

from scilab_rl.envs.types import Info, ResetResult

_GRAVITY = -9.81  # panda-gym's, in m/s^2


class Repeatable(RobotTaskEnv):
    """The parts that all tasks share; it comes before the task in the order of classes."""

    action_space: spaces.Box
    observation_space: spaces.Dict
    _constructor_arguments: tuple[tuple[object, ...], dict[str, object]]
    _is_new: bool
    _is_building: bool

    def __new__(cls, *args: object, **kwargs: object) -> Repeatable:
        """Remember the arguments, which the world is built from."""
        self = super().__new__(cls)
        self._constructor_arguments = args, kwargs
        self._is_new = self._is_building = True
        self.metadata = dict(cls.metadata)  # panda-gym writes into it
        return self

    def __init__(self, *args: object, **kwargs: object) -> None:
        self._is_building = True
        super().__init__(*args, **kwargs)
        self._is_building = False
        self.compute_reward = self._compute_reward  # panda-gym takes that of the first world
        # Objects move faster than the 10 m/s that panda-gym declares.
        self.observation_space = spaces.Dict(
            {
                key: spaces.Box(-np.inf, np.inf, space.shape, np.float32)
                for key, space in self.observation_space.spaces.items()
            }
        )

    def reset(self, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin an episode in a new world."""
        if self._is_building:
            return super().reset(seed=seed, options=options)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        if not self._is_new:
            self._build_again()
        self._is_new = False
        return super().reset(seed=seed, options=options)

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return whether the goal is reached, which ends an episode. Shapes: ``(..., 3)``."""
        return self.task.is_success(np.asarray(achieved_goal), np.asarray(desired_goal))

    def _compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        return self.task.compute_reward(achieved_goal, desired_goal, info)

    def _build_again(self) -> None:
        sim = self.sim
        sim.physics_client.resetSimulation()
        sim.physics_client.setTimeStep(sim.timestep)
        sim.physics_client.setGravity(0, 0, _GRAVITY)
        sim._bodies_idx = {}
        args, kwargs = self._constructor_arguments
        action_space = self.action_space  # it may be seeded
        with mock.patch.object(panda_tasks, "PyBullet", lambda **_: sim):
            type(self).__init__(self, *args, **kwargs)
        self.action_space = action_space

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as a new environment with the same arguments."""
        args, kwargs = self._constructor_arguments
        return functools.partial(type(self), *args, **kwargs), ()


def _repeatable(task: type[RobotTaskEnv]) -> type[Repeatable]:
    return type(
        task.__name__, (Repeatable, task), {"__module__": __name__, "__doc__": task.__doc__}
    )


PandaFlipEnv = _repeatable(panda_tasks.PandaFlipEnv)
PandaPickAndPlaceEnv = _repeatable(panda_tasks.PandaPickAndPlaceEnv)
PandaPushEnv = _repeatable(panda_tasks.PandaPushEnv)
PandaReachEnv = _repeatable(panda_tasks.PandaReachEnv)
PandaSlideEnv = _repeatable(panda_tasks.PandaSlideEnv)
PandaStackEnv = _repeatable(panda_tasks.PandaStackEnv)


def register() -> None:
    """Let panda-gym's ids make these classes."""
    for spec in gym.registry.values():
        module, _, name = str(spec.entry_point).partition(":")
        if module == "panda_gym.envs":
            spec.entry_point = f"{__name__}:{name}"
