"""The base class of tasks for the Fetch robot's arm."""

from __future__ import annotations

from string import Template
from typing import Any

import mujoco
import numpy as np

from scilab_rl.envs.mujoco_goal import ASSETS, MujocoGoalEnv, package_folder

TABLE_HEIGHT = 0.4
STEP_LENGTH = 0.05
FINGER_JOINTS = ("robot0:l_gripper_finger_joint", "robot0:r_gripper_finger_joint")
_START_JOINTS = {"robot0:slide0": 0.405, "robot0:slide1": 0.48, "robot0:slide2": 0.0}
# Where the gripper is held at the start, as in Fetch; its link is 2 cm above the finger tips.
_START_PLACE, _LINK_HEIGHT = (1.3419, 0.7491), 0.02
_POINTING_DOWN = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
_SETTLING_STEPS = 10


class FetchTask(MujocoGoalEnv):
    """A task for an arm whose gripper is moved by up to 5 cm per axis and step.

    The arm, its control and its step of 0.04 s are those of Gymnasium-Robotics' Fetch tasks. An
    action is the gripper's movement in x, y and z and the fingers' opening (1) or closing (-1).

    Args:
        objects: What lies on the table, as XML below ``worldbody``; sites for goal markers too.
        table: Place of the table's middle on the x axis and half its length, in m.
        kwargs: Those of `MujocoGoalEnv`.

    Attributes:
        fingers_closed: Whether the fingers stay closed, whatever the action.
        start_height: The height of the place between the finger tips at the start, in m.
        gripper: Site between the finger tips.
        start: Where it is at the start of an episode. Shapes: ``(3,)`` in m.
    """

    metadata = {  # noqa: RUF012 - Gymnasium's
        **MujocoGoalEnv.metadata,
        "units": {
            "observation": "positions in m, Euler angles in rad, velocities in m or rad per step",
            "achieved_goal": "m",
            "desired_goal": "m",
            "action": f"{STEP_LENGTH} m per axis and step; fingers: 1 opens, -1 closes",
        },
    }
    action_size = 4
    fingers_closed: bool = False
    start_height: float = 0.535
    camera = {"distance": 1.35, "azimuth": 140.0, "elevation": -25.0, "lookat": (1.25, 0.75, 0.52)}  # noqa: RUF012

    def __init__(
        self, objects: str = "", *, table: tuple[float, float] = (1.3, 0.25), **kwargs: Any
    ) -> None:
        arena = Template((ASSETS / "fetch_arena.xml").read_text(encoding="utf-8"))
        xml = arena.substitute(
            robot=package_folder("gymnasium_robotics") / "envs" / "assets",
            table_x=table[0],
            table_half_length=table[1],
            objects=objects,
        )
        super().__init__(xml, n_substeps=20, **kwargs)

    def set_up(self) -> None:
        """Move the arm over the table and let it come to rest."""
        model, data = self.model, self.data
        self.gripper = self.site("robot0:grip")
        self._link = int(model.body("robot0:gripper_link").id)
        self._hand = int(model.body("robot0:mocap").mocapid[0])
        self._fingers = [int(model.joint(name).qposadr[0]) for name in FINGER_JOINTS]
        self._finger_speeds = [int(model.joint(name).dofadr[0]) for name in FINGER_JOINTS]
        for name, place in _START_JOINTS.items():
            data.joint(name).qpos = place
        # The mocap body's long cross is of no interest to the viewer.
        model.geom_rgba[model.geom_bodyid == model.body("robot0:mocap").id, 3] = 0.0
        # The weld holds the link exactly at the mocap body: no offset, no turn.
        model.eq_data[0, :10] = (0, 0, 0, 0, 0, 0, 1, 0, 0, 0)
        data.mocap_pos[self._hand] = *_START_PLACE, self.start_height + _LINK_HEIGHT
        data.mocap_quat[self._hand] = _POINTING_DOWN
        mujoco.mj_step(model, data, nstep=_SETTLING_STEPS * self.n_substeps)
        data.time = 0.0
        mujoco.mj_forward(model, data)
        self.start = self.gripper_position()

    def set_control(self, action: np.ndarray) -> None:
        """Move the gripper relative to where it is now."""
        model, data = self.model, self.data
        data.mocap_pos[self._hand] = data.xpos[self._link] + self.movement(action)
        data.mocap_quat[self._hand] = _POINTING_DOWN
        data.ctrl[:] = 0.0 if self.fingers_closed else data.qpos[self._fingers] + action[-1]
        np.clip(data.ctrl, *model.actuator_ctrlrange.T, out=data.ctrl)

    def movement(self, action: np.ndarray) -> np.ndarray:
        """Return by how much an action moves the gripper. Shapes: ``(3,)`` in m."""
        return STEP_LENGTH * action[:3]

    def gripper_position(self) -> np.ndarray:
        """Return the place between the finger tips. Shapes: ``(3,)`` in m."""
        return self.data.site_xpos[self.gripper].copy()

    def gripper_velocity(self) -> np.ndarray:
        """Return by how much it moves in one step at this speed. Shapes: ``(3,)`` in m."""
        return self.site_velocity(self.gripper)[3:] * self.dt

    def finger_state(self) -> np.ndarray:
        """Return how far the fingers are open. Shapes: ``(2,)`` in m."""
        return self.data.qpos[self._fingers]

    def finger_velocity(self) -> np.ndarray:
        """Return by how much they open in one step at this speed. Shapes: ``(2,)`` in m."""
        return self.data.qvel[self._finger_speeds] * self.dt
