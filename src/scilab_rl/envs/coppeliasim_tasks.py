"""Two goal tasks in CoppeliaSim whose scenes are built from primitives: no scene file is needed."""

from __future__ import annotations

import numpy as np

from scilab_rl.envs.coppeliasim import CoppeliaSimEnv

_GREY, _BLUE, _RED = (0.4, 0.4, 0.4), (0.2, 0.45, 0.8), (0.85, 0.2, 0.15)


class CoppeliaReach(CoppeliaSimEnv):
    """Reach a place with the tip of an arm of three joints.

    The first joint turns the arm about the vertical, the others lift it. An action is the joints'
    speeds. The observation is the joint angles as cosine and sine and the tip's place; the goal is
    a place that some joint angles reach.

    Args:
        kwargs: Those of `CoppeliaSimEnv` and `GoalEnv`.
    """

    action_size = 3
    threshold = 0.05
    max_speed = 1.5  # rad/s
    links = (0.3, 0.25)  # m
    base_height = 0.2
    low = np.array([-1.5, -0.2, -1.8])
    high = np.array([1.5, 1.4, -0.2])
    rest = np.array([0.0, 0.6, -1.0])

    def build_scene(self) -> None:
        """Create base, joints, links, tip and the goal's marker."""
        sim = self.sim
        base = self.create_shape("cylinder", (0.12, 0.12, self.base_height), _GREY)
        self.set_position(base, (0.0, 0.0, self.base_height / 2))
        # A joint turns about its z axis; a quarter turn about x lets the lifting axes lie flat.
        flat = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
        offsets = [
            [0.0, 0.0, self.base_height / 2, 0.0, 0.0, 0.0, 1.0],
            [0.0, 0.0, 0.0, *flat],
            [self.links[0], 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        ]
        self._joints: list[int] = []
        parent = base
        for offset in offsets:
            joint = sim.createJoint(sim.joint_revolute_subtype, sim.jointmode_kinematic, 0)
            sim.setObjectParent(joint, parent, False)
            sim.setObjectPose(joint, [float(number) for number in offset], parent)
            self._joints.append(int(joint))
            parent = joint
        for joint, length in zip(self._joints[1:], self.links, strict=True):
            link = self.create_shape("cuboid", (length, 0.05, 0.05), _BLUE, joint)
            sim.setObjectPosition(link, [length / 2, 0.0, 0.0], joint)
        self._tip = int(sim.createDummy(0.02))
        sim.setObjectParent(self._tip, self._joints[-1], False)
        sim.setObjectPosition(self._tip, [self.links[1], 0.0, 0.0], self._joints[-1])
        self._marker = self.create_shape("spheroid", (0.05, 0.05, 0.05), _RED)

    def place_objects(self) -> None:
        """Bring the arm to rest."""
        self.set_joint_positions(self._joints, self.rest)

    def sample_goal(self) -> np.ndarray:
        """Draw joint angles and return where the tip is with them. Shapes: ``(3,)`` in m."""
        goal = self.tip_place(self.np_random.uniform(self.low, self.high))
        self.set_position(self._marker, goal)
        return goal

    def tip_place(self, angles: np.ndarray) -> np.ndarray:
        """Return the tip's place for joint angles. Shapes: ``(3,)`` to ``(3,)`` in m."""
        upper, lower = angles[1], angles[1] + angles[2]
        out = self.links[0] * np.cos(upper) + self.links[1] * np.cos(lower)
        up = self.links[0] * np.sin(upper) + self.links[1] * np.sin(lower)
        return np.array([out * np.cos(angles[0]), out * np.sin(angles[0]), self.base_height + up])

    def set_control(self, action: np.ndarray) -> None:
        """Turn the joints, within their limits."""
        moved = self._angles() + self.max_speed * self.step_seconds * action
        self.set_joint_positions(self._joints, np.clip(moved, self.low, self.high))

    def achieved_goal(self) -> np.ndarray:
        """Return the tip's place. Shapes: ``(3,)`` in m."""
        return self.position(self._tip)

    def get_observation(self) -> np.ndarray:
        """Return the angles and the tip's place. Shapes: ``(9,)``."""
        angles = self._angles()
        return np.concatenate([np.cos(angles), np.sin(angles), self.position(self._tip)])

    def _angles(self) -> np.ndarray:
        return self.joint_positions(self._joints)


class CoppeliaDrive(CoppeliaSimEnv):
    """Drive a robot with two wheels around a pillar to a place.

    An action is the speed forwards and the speed of turning. The robot does not move on where it
    would touch the pillar. The observation is its place and heading as cosine and sine.

    Args:
        kwargs: Those of `CoppeliaSimEnv` and `GoalEnv`.
    """

    action_size = 2
    threshold = 0.1
    max_speed = 1.0  # m/s
    max_turn = 2.0  # rad/s
    work_range = 0.9
    pillar_radius = 0.15
    size = (0.2, 0.14, 0.1)

    def build_scene(self) -> None:
        """Create robot, pillar and the goal's marker."""
        self._robot = self.create_shape("cuboid", self.size, _BLUE)
        width = 2 * self.pillar_radius
        self._pillar = self.create_shape("cylinder", (width, width, 0.4), _GREY)
        self.set_position(self._pillar, (0.0, 0.0, 0.2))
        self._marker = self.create_shape("spheroid", (0.08, 0.08, 0.08), _RED)

    def place_objects(self) -> None:
        """Put the robot next to the pillar, in any direction."""
        heading = self.np_random.uniform(-np.pi, np.pi)
        self._move(np.array([*self._free_place(), heading]))

    def sample_goal(self) -> np.ndarray:
        """Draw a place. Shapes: ``(2,)`` in m."""
        goal = self._free_place()
        while np.linalg.norm(goal - self._state[:2]) < 0.5:
            goal = self._free_place()
        self.set_position(self._marker, (*goal, 0.05))
        return goal

    def set_control(self, action: np.ndarray) -> None:
        """Drive a step, unless the pillar is in the way."""
        before = self._state
        heading = before[2] + self.max_turn * self.step_seconds * action[1]
        way = self.max_speed * self.step_seconds * action[0]
        moved = before[:2] + way * np.array([np.cos(heading), np.sin(heading)])
        self._move(np.array([*np.clip(moved, -1.0, 1.0), heading]))
        if self.collide(self._robot, self._pillar):
            self._move(np.array([*before[:2], heading]))

    def achieved_goal(self) -> np.ndarray:
        """Return the robot's place. Shapes: ``(2,)`` in m."""
        return self.position(self._robot)[:2]

    def get_observation(self) -> np.ndarray:
        """Return place and heading. Shapes: ``(4,)``."""
        heading = self._state[2]
        return np.array([*self.achieved_goal(), np.cos(heading), np.sin(heading)])

    def _free_place(self) -> np.ndarray:
        while True:
            place = self.np_random.uniform(-self.work_range, self.work_range, 2)
            if np.linalg.norm(place) > self.pillar_radius + max(self.size):
                return place

    def _move(self, state: np.ndarray) -> None:
        """Put the robot somewhere. Shapes: x and y in m, heading in rad."""
        self._state = state
        turn = [0.0, 0.0, np.sin(state[2] / 2), np.cos(state[2] / 2)]
        self.set_pose(self._robot, [*state[:2], self.size[2] / 2, *turn])
