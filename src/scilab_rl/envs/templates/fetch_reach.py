"""The Fetch arm has to bring its gripper somewhere. Say here what your task is."""

from __future__ import annotations

from typing import Any

import numpy as np

from scilab_rl.envs.fetch_task import FetchTask

# What is on the table, and the markers of the goal, as MuJoCo's XML.
OBJECTS = '<site name="goal" size="0.02" rgba="0.9 0.15 0.15 0.8"/>'


class MyTask(FetchTask):
    """Move the gripper to a place within 15 cm of its start."""

    fingers_closed = True
    threshold = 0.05

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(OBJECTS, **kwargs)

    def sample_goal(self) -> np.ndarray:
        """Draw a place in m; take all chance from ``self.np_random``."""
        return self.start + self.np_random.uniform(-0.15, 0.15, 3)

    def achieved_goal(self) -> np.ndarray:
        """Return what is compared with the goal."""
        return self.gripper_position()

    def get_observation(self) -> np.ndarray:
        """Return the observation without the goals."""
        return np.concatenate([self.gripper_position(), self.gripper_velocity()])

    def goal_markers(self) -> dict[str, np.ndarray]:
        """Draw the goal."""
        return {"goal": self.goal}
