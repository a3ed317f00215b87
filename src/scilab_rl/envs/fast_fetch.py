"""Fetch without its look-ups by name, which take more than a third of a step.

Gymnasium-Robotics asks MuJoCo for each joint by its name, 30 times per step. Its environments reach
these functions through one attribute, so an object with the same functions and remembered indices
takes their place. The arithmetic is the same, so observations are equal to the last bit.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

_FETCH_MODULE = "gymnasium_robotics.envs.fetch.fetch_env"
_ONE_NUMBER = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def speed_up(env: gym.Env) -> bool:
    """Replace the look-ups of a Fetch environment; leave others alone.

    Args:
        env: Any environment.

    Returns:
        Whether it is a Fetch environment.
    """
    module, inner = sys.modules.get(_FETCH_MODULE), env.unwrapped
    if module is None or not isinstance(inner, module.MujocoFetchEnv):
        return False
    if isinstance(inner._utils, ModuleType):
        inner._utils = RememberedLookups(inner.model, inner._utils)
    return True


class RememberedLookups:
    """The functions of ``gymnasium_robotics.utils.mujoco_utils`` for one model.

    Those that are not here are the original ones. The ``model`` of each call must be that of the
    constructor.

    Args:
        model: The MuJoCo model.
        original: The module that is replaced.
    """

    def __init__(self, model: Any, original: Any) -> None:
        self._original = original
        self._sites = {model.site(i).name: i for i in range(model.nsite)}
        self._jacobian = np.zeros((3, model.nv))
        joints = [model.joint(i) for i in range(model.njnt)]
        self._places = {j.name: int(j.qposadr[0]) for j in joints if j.type[0] in _ONE_NUMBER}
        robot = [j for j in joints if j.name.startswith("robot")]
        self._robot_places = np.array([j.qposadr[0] for j in robot])
        self._robot_speeds = np.array([j.dofadr[0] for j in robot])
        self._n_mocap_numbers = 7 * model.nmocap
        self._is_relative = model.actuator_biastype != 0
        self._actuated = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._welds = _welded_bodies(model)

    def __getattr__(self, name: str) -> Any:
        """Return the original of a function that is not replaced."""
        return getattr(self._original, name)

    def robot_get_obs(self, model: Any, data: Any, joint_names: Any) -> Any:
        """Return positions and velocities of the robot's joints. Shapes: ``(n_joints,)`` each."""
        return data.qpos[self._robot_places], data.qvel[self._robot_speeds]

    def get_site_xpos(self, model: Any, data: Any, name: str) -> np.ndarray:
        """Return a site's place. Shapes: ``(3,)``."""
        return data.site_xpos[self._sites[name]]

    def get_site_xmat(self, model: Any, data: Any, name: str) -> np.ndarray:
        """Return a site's rotation. Shapes: ``(3, 3)``."""
        return data.site_xmat[self._sites[name]].reshape(3, 3)

    def get_site_xvelp(self, model: Any, data: Any, name: str) -> np.ndarray:
        """Return a site's velocity. Shapes: ``(3,)``."""
        mujoco.mj_jacSite(model, data, self._jacobian, None, self._sites[name])
        return self._jacobian @ data.qvel

    def get_site_xvelr(self, model: Any, data: Any, name: str) -> np.ndarray:
        """Return a site's angular velocity. Shapes: ``(3,)``."""
        mujoco.mj_jacSite(model, data, None, self._jacobian, self._sites[name])
        return self._jacobian @ data.qvel

    def set_joint_qpos(self, model: Any, data: Any, name: str, value: Any) -> None:
        """Set the position of a joint."""
        if name in self._places:
            data.qpos[self._places[name]] = value
        else:
            self._original.set_joint_qpos(model, data, name, value)

    def ctrl_set_action(self, model: Any, data: Any, action: np.ndarray) -> None:
        """Set forces, or positions relative to the present ones."""
        action = action[self._n_mocap_numbers :][: model.nu]
        present = np.where(self._is_relative, data.qpos[self._actuated], 0.0)
        data.ctrl[: len(action)] = present[: len(action)] + action

    def mocap_set_action(self, model: Any, data: Any, action: np.ndarray) -> None:
        """Move the bodies that lead the robot relative to those that follow them."""
        movement = action[: self._n_mocap_numbers].reshape(-1, 7)
        for leader, follower in self._welds:
            data.mocap_pos[leader] = data.xpos[follower]
            data.mocap_quat[leader] = data.xquat[follower]
        data.mocap_pos[:] = data.mocap_pos + movement[:, :3]
        data.mocap_quat[:] = data.mocap_quat + movement[:, 3:]


def _welded_bodies(model: Any) -> list[tuple[int, int]]:
    """Return each mocap index with the body that is welded to it."""
    pairs = []
    for kind, first, second in zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True):
        if kind != mujoco.mjtEq.mjEQ_WELD:
            continue
        leader, follower = first, second
        if model.body_mocapid[leader] == -1:
            leader, follower = second, first
        pairs.append((int(model.body_mocapid[leader]), int(follower)))
    return pairs
