"""Reach1DOF: the smallest task with a real arm, one action and one goal dimension."""

from __future__ import annotations

from typing import Any

import numpy as np

from scilab_rl.envs.fetch_task import STEP_LENGTH, FetchTask

_MARKER = '<site name="goal" size="0.02" rgba="0.9 0.15 0.15 0.8"/>'


class Reach1DOF(FetchTask):
    """Move the gripper along the x axis to a place within 15 cm of its start.

    The observation is the gripper's x and its movement per step, the goal is an x.

    Args:
        kwargs: Those of `GoalEnv`: reward_type (sparse | dense), threshold, ...
    """

    metadata = {  # noqa: RUF012 - Gymnasium's
        **FetchTask.metadata,
        "units": {
            "observation": "m, m per step",
            "achieved_goal": "m",
            "desired_goal": "m",
            "action": f"{STEP_LENGTH} m of the gripper along x per step",
        },
    }
    action_size = 1
    fingers_closed = True
    goal_range = 0.15

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(_MARKER, **kwargs)

    def sample_goal(self) -> np.ndarray:
        """Draw an x."""
        return self.start[:1] + self.np_random.uniform(-self.goal_range, self.goal_range, 1)

    def achieved_goal(self) -> np.ndarray:
        """Return the gripper's x."""
        return self.gripper_position()[:1]

    def get_observation(self) -> np.ndarray:
        """Return the gripper's x and its movement per step. Shapes: ``(2,)``."""
        return np.array([self.gripper_position()[0], self.gripper_velocity()[0]])

    def movement(self, action: np.ndarray) -> np.ndarray:
        """Move along x and hold y and z."""
        back = self.start - self.gripper_position()
        return np.array([STEP_LENGTH * action[0], back[1], back[2]])

    def goal_markers(self) -> dict[str, np.ndarray]:
        """Draw the goal as a ball in the gripper's path."""
        return {"goal": np.array([self.goal[0], self.start[1], self.start[2]])}
