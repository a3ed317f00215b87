"""Blocks: stack up to four blocks into a tower at a random place."""

from __future__ import annotations

from typing import Any

import numpy as np

from scilab_rl.envs.fetch_task import TABLE_HEIGHT, FetchTask
from scilab_rl.envs.goal import require_choice
from scilab_rl.envs.mujoco_goal import euler_angles

BLOCK_SIZE = 0.05
GRIPPER_GOALS = ("none", "random", "above")
_COLORS = ("0.85 0.25 0.2", "0.2 0.5 0.85", "0.95 0.75 0.2", "0.3 0.7 0.35")
_GRIPPER_COLOR = "0.1 0.1 0.1"
# Two blocks that are turned by 45 degrees do not touch at the length of their diagonal.
_CLEARANCE = 1.45 * BLOCK_SIZE


class Blocks(FetchTask):
    """Stack blocks of 5 cm with a Fetch arm.

    The goal is the place of each block, all in one tower, before them the gripper's place unless
    ``gripper_goal`` is ``none``. It is reached when the worst placed part is within the threshold,
    whatever the number of blocks. The observation is the gripper's and the blocks' positions, the
    fingers' opening, the blocks' Euler angles, and the velocities of gripper, blocks (linear, then
    angular) and fingers, per step as in Gymnasium-Robotics' Fetch tasks.

    Args:
        n_blocks: From 0 to 4. Allow 50 steps per block: ``env_kwargs.max_episode_steps``.
        gripper_goal: ``none``, ``random`` (a place in the air above the tower) or ``above`` (right
            on top of the tower). Without blocks only ``random``.
        kwargs: Those of `FetchTask` and `GoalEnv`: reward_type (sparse | dense), threshold, ...
    """

    max_blocks = 4
    work_range = 0.15

    def __init__(
        self, n_blocks: int = 1, gripper_goal: str = "none", objects: str = "", **kwargs: Any
    ) -> None:
        require_choice("n_blocks", n_blocks, range(self.max_blocks + 1))
        allowed = GRIPPER_GOALS if n_blocks else ("random",)
        require_choice("gripper_goal", gripper_goal, allowed)
        self.n_blocks = n_blocks
        self.gripper_goal = gripper_goal
        self.fingers_closed = n_blocks == 0
        super().__init__(objects + _blocks_xml(n_blocks), **kwargs)

    def set_up(self) -> None:
        """Look up where the blocks are in the state vectors, and settle."""
        joints = [self.model.joint(f"block{index}") for index in range(self.n_blocks)]
        bodies = [self.model.body(f"block{index}") for index in range(self.n_blocks)]
        self._blocks = np.array([body.id for body in bodies], dtype=int)
        self._block_places = _addresses([joint.qposadr[0] for joint in joints], 3)
        self._block_speeds = _addresses([joint.dofadr[0] for joint in joints], 6)
        super().set_up()

    def place_objects(self) -> None:
        """Put the blocks on the table, apart from one another."""
        places: list[np.ndarray] = []
        while len(places) < self.n_blocks:
            place = self.start_place()
            if all(np.linalg.norm(place - other) > _CLEARANCE for other in places):
                places.append(place)
        for addresses, place in zip(self._block_places, places, strict=True):
            self.data.qpos[addresses] = [*place, TABLE_HEIGHT + BLOCK_SIZE / 2]

    def start_place(self) -> np.ndarray:
        """Draw where a block lies at the start. Shapes: ``(2,)`` in m."""
        return self._random_place()

    def sample_goal(self) -> np.ndarray:
        """Draw a tower that does not stand already."""
        goal = self._draw_goal()
        while self.distance(self.achieved_goal(), goal) <= self.threshold:
            goal = self._draw_goal()
        return goal

    def achieved_goal(self) -> np.ndarray:
        """Return the places of the gripper, if it counts, and of the blocks."""
        blocks = self._block_positions().ravel()
        if self.gripper_goal == "none":
            return blocks
        return np.concatenate([self.gripper_position(), blocks])

    def distance(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Return the distance of the part that is farthest from its place.

        Shapes:
            achieved_goal, desired_goal: ``(..., 3 n_parts)``; result: ``(...)`` in m.
        """
        difference = np.asarray(achieved_goal) - np.asarray(desired_goal)
        parts = difference.reshape(*difference.shape[:-1], -1, 3)
        return np.linalg.norm(parts, axis=-1).max(axis=-1)

    def get_observation(self) -> np.ndarray:
        """Return positions, angles and velocities. Shapes: ``(10 + 12 n_blocks,)``."""
        speeds = self._block_velocities()
        return np.concatenate(
            [
                self.gripper_position(),
                self._block_positions().ravel(),
                self.finger_state(),
                euler_angles(self.data.xmat[self._blocks]).ravel(),
                self.gripper_velocity(),
                speeds[:, :3].ravel(),
                speeds[:, 3:].ravel(),
                self.finger_velocity(),
            ]
        )

    def goal_markers(self) -> dict[str, np.ndarray]:
        """Draw each part's place as a transparent ghost."""
        parts = self.goal.reshape(-1, 3)
        names = [f"goal{index}" for index in range(self.n_blocks)]
        if self.gripper_goal != "none":
            names.insert(0, "gripper_goal")
        return dict(zip(names, parts, strict=True))

    def _draw_goal(self) -> np.ndarray:
        """Draw the tower's place, and the gripper's above it. Shapes: ``(3 n_parts,)``."""
        x, y = self._random_place()
        heights = TABLE_HEIGHT + BLOCK_SIZE * (np.arange(self.n_blocks + 1) + 0.5)
        tower = [np.array([x, y, height]) for height in heights]
        free = tower.pop()  # where the next block would be
        if self.gripper_goal == "random":
            free = np.array([*self._random_place(), free[2] + self.np_random.uniform(0.0, 0.2)])
        parts = tower if self.gripper_goal == "none" else [free, *tower]
        return np.concatenate(parts)

    def _random_place(self) -> np.ndarray:
        return self.start[:2] + self.np_random.uniform(-self.work_range, self.work_range, 2)

    def _block_positions(self) -> np.ndarray:
        return self.data.xpos[self._blocks]

    def _block_velocities(self) -> np.ndarray:
        """Return linear and angular velocities per step. Shapes: ``(n_blocks, 6)``."""
        velocities = self.data.qvel[self._block_speeds]
        rotations = self.data.xmat[self._blocks].reshape(-1, 3, 3)
        # MuJoCo gives the angular velocity of a free body in the body's own axes.
        angular = np.einsum("nij,nj->ni", rotations, velocities[:, 3:])
        return np.concatenate([velocities[:, :3], angular], axis=1) * self.dt


def _addresses(starts: list[int], length: int) -> np.ndarray:
    """Return the indices of each object's entries. Shapes: ``(n_objects, length)``."""
    return np.array(starts, dtype=int).reshape(-1, 1) + np.arange(length)


def _blocks_xml(n_blocks: int) -> str:
    """Return the blocks, which start in a row, and the markers of their goals."""
    half = BLOCK_SIZE / 2
    parts = [f'<site name="gripper_goal" pos="0 0 -1" size="0.02" rgba="{_GRIPPER_COLOR} 0.7"/>']
    for index, color in zip(range(n_blocks), _COLORS, strict=False):
        parts.append(
            f'<body name="block{index}" pos="1.2 {0.6 + 0.1 * index} {TABLE_HEIGHT + half}">'
            f'<freejoint name="block{index}"/>'
            f'<geom type="box" size="{half} {half} {half}" mass="2" rgba="{color} 1"/></body>'
            f'<site name="goal{index}" type="box" size="{half} {half} {half}" '
            f'rgba="{color} 0.3"/>'
        )
    return "\n".join(parts)
