"""Hook: blocks that lie out of reach must be pulled with a tool."""

from __future__ import annotations

from typing import Any

import numpy as np

from scilab_rl.envs.blocks import Blocks
from scilab_rl.envs.fetch_task import TABLE_HEIGHT
from scilab_rl.envs.mujoco_goal import euler_angles

_HANDLE, _TIP, _THICK = 0.4, 0.14, 0.025
# The gripper comes as far as x = 1.70 m at the height of the table.
_TABLE = (1.5, 0.45)
_FAR_X = (1.74, 1.84)
_HOOK_XML = f"""
<body name="hook" pos="1.3 0.95 {TABLE_HEIGHT + _THICK / 2}">
  <freejoint name="hook"/>
  <geom type="box" size="{_HANDLE / 2} {_THICK / 2} {_THICK / 2}" mass="0.3"
        friction="1.5 0.01 0.001" condim="4" rgba="0.45 0.3 0.2 1"/>
  <geom type="box" size="{_THICK / 2} {_TIP / 2} {_THICK / 2}" mass="0.1" rgba="0.45 0.3 0.2 1"
        pos="{(_HANDLE - _THICK) / 2} {-_TIP / 2} 0"/>
</body>
"""


class Hook(Blocks):
    """`Blocks` on a longer table, with a hook; blocks can lie where only the hook reaches.

    The goal is a tower of the blocks near the robot, or a place for the gripper when there is no
    block. After the observation of `Blocks` come the hook's position, Euler angles, linear and
    angular velocity.

    Args:
        n_blocks: From 0 to 2. Allow 100 steps per block: ``env_kwargs.max_episode_steps``.
        kwargs: Those of `FetchTask` and `GoalEnv`: reward_type (sparse | dense), threshold, ...
    """

    max_blocks = 2
    far_share = 0.5  # of the blocks that lie out of reach

    def __init__(self, n_blocks: int = 1, **kwargs: Any) -> None:
        gripper_goal = "none" if n_blocks else "random"
        super().__init__(n_blocks, gripper_goal, _HOOK_XML, table=_TABLE, **kwargs)
        self.camera = {**self.camera, "distance": 1.6, "lookat": (1.4, 0.75, 0.5)}

    def set_up(self) -> None:
        """Look up where the hook is in the state vectors, and settle."""
        self._hook = int(self.model.body("hook").id)
        self._hook_place = int(self.model.joint("hook").qposadr[0])
        self._hook_speed = int(self.model.joint("hook").dofadr[0])
        super().set_up()
        # An arm without blocks could do without fingers, but not with a hook to hold.
        self.fingers_closed = False

    def place_objects(self) -> None:
        """Put the hook on the robot's left and the blocks to its right or far away."""
        x, y = self.np_random.uniform((1.26, 0.92), (1.32, 1.0))
        self.data.qpos[self._hook_place : self._hook_place + 2] = x, y
        super().place_objects()

    def start_place(self) -> np.ndarray:
        """Draw a place within or beyond the arm's reach, clear of the hook."""
        x = self.start[0] + self.np_random.uniform(-self.work_range, self.work_range)
        if self.np_random.random() < self.far_share:
            x = self.np_random.uniform(*_FAR_X)
        return np.array([x, self.np_random.uniform(0.6, 0.75)])

    def get_observation(self) -> np.ndarray:
        """Return positions, angles and velocities. Shapes: ``(22 + 12 n_blocks,)``."""
        velocity = self.data.qvel[self._hook_speed : self._hook_speed + 6] * self.dt
        rotation = self.data.xmat[self._hook]
        angular = rotation.reshape(3, 3) @ velocity[3:]
        hook = [self.data.xpos[self._hook], euler_angles(rotation), velocity[:3], angular]
        return np.concatenate([super().get_observation(), *hook])
