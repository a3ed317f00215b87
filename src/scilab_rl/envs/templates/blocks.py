"""The Fetch arm has to put blocks somewhere. Say here what your task is."""

from __future__ import annotations

from typing import Any

import numpy as np

from scilab_rl.envs.blocks import BLOCK_SIZE, Blocks
from scilab_rl.envs.fetch_task import TABLE_HEIGHT


class MyTask(Blocks):
    """Put two blocks side by side, 10 cm apart."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(n_blocks=2, gripper_goal="none", **kwargs)

    def start_place(self) -> np.ndarray:
        """Draw where a block lies at the start: x and y in m."""
        return self.start[:2] + self.np_random.uniform(-0.1, 0.1, 2)

    def sample_goal(self) -> np.ndarray:
        """Draw the places of all blocks, one after the other."""
        middle = self.start[:2] + self.np_random.uniform(-0.1, 0.1, 2)
        height = TABLE_HEIGHT + BLOCK_SIZE / 2
        return np.array([middle[0], middle[1] - 0.05, height, middle[0], middle[1] + 0.05, height])
