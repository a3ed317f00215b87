"""A point in the plane that has to get somewhere. Say here what your task is."""

from __future__ import annotations

import numpy as np

from scilab_rl.envs.goal import GoalEnv


class MyTask(GoalEnv):
    """Move a point to the goal; an action is its movement in x and y."""

    action_size = 2
    threshold = 0.1
    drawn_range = (-1.0, 1.0)  # of the axes in pictures

    def reset_state(self) -> None:
        """Begin in the middle."""
        self.place = np.zeros(2)

    def sample_goal(self) -> np.ndarray:
        """Draw a place; take all chance from ``self.np_random``."""
        return self.np_random.uniform(-1.0, 1.0, 2)

    def apply_action(self, action: np.ndarray) -> None:
        """Move by up to a tenth per axis."""
        self.place = np.clip(self.place + 0.1 * action, -1.0, 1.0)

    def achieved_goal(self) -> np.ndarray:
        """Return what is compared with the goal."""
        return self.place

    def get_observation(self) -> np.ndarray:
        """Return the observation without the goals."""
        return self.place
