"""Fetch without its look-ups by name, which take more than a third of a step.

Gymnasium-Robotics asks MuJoCo for each joint by its name, 30 times per step. Its environments reach
these functions through one attribute, so an object with the same functions and remembered indices
takes their place. What turns an action into controls and the simulation into an observation is
replaced as well, where a subclass has not changed it: many small steps of NumPy become few. The
arithmetic is the same, so observations are equal to the last bit.
"""

from __future__ import annotations

import math
import sys
from types import ModuleType
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from scilab_rl.envs.types import StepResult

_FETCH_MODULE = "gymnasium_robotics.envs.fetch.fetch_env"
# Methods whose work `FetchView` does.
_REPLACED = (
    "step", "_set_action", "_mujoco_step", "_get_obs", "generate_mujoco_observations",
    "_is_success", "compute_reward", "compute_terminated", "compute_truncated",
)  # fmt: skip
_TURN = np.array([1.0, 0.0, 1.0, 0.0])  # how the gripper is held, as a quaternion
_SMALL = 4.0 * np.finfo(np.float64).eps
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
        inner._utils = lookups = RememberedLookups(inner.model, inner._utils)
        if lookups.has_one_hand and _is_unchanged(type(inner), module.MujocoFetchEnv):
            view = FetchView(inner, lookups)
            inner._get_obs, inner._set_action, inner.step = view.observe, view.act, view.step
    return True


def _is_unchanged(task: type, base: type) -> bool:
    """Return whether a task observes and acts as all of Gymnasium-Robotics' Fetch tasks do."""
    return all(getattr(task, name) is getattr(base, name) for name in _REPLACED)


class FetchView:
    """What a Fetch task observes, and how it acts, with remembered places in memory.

    Args:
        env: The innermost environment.
        lookups: Of its model.
    """

    def __init__(self, env: Any, lookups: RememberedLookups) -> None:
        self._env, self._lookups = env, lookups
        self._original_step = env.step
        self._time = env.n_substeps * env.model.opt.timestep
        data, sites = env.data, lookups.sites
        self._grip, self._grip_place = sites["robot0:grip"], data.site_xpos[sites["robot0:grip"]]
        self._finger_places, self._finger_speeds = (
            lookups.robot_places[-2:],
            lookups.robot_speeds[-2:],
        )
        self._qpos, self._qvel, self._ctrl = data.qpos, data.qvel, data.ctrl
        ((leader, follower),) = lookups.welds
        self._hand_place, self._hand_turn = data.mocap_pos[leader], data.mocap_quat[leader]
        self._link_place, self._link_turn = data.xpos[follower], data.xquat[follower]
        self._grip_jacobian = np.zeros((3, env.model.nv))
        if env.has_object:
            self._object = sites["object0"]
            self._object_place = data.site_xpos[self._object]
            self._object_turn = data.site_xmat[self._object]
            self._object_jacobians = np.zeros((2, 3, env.model.nv))

    def step(self, action: np.ndarray) -> StepResult:
        """Act for one step. Shapes: ``(4,)``."""
        env = self._env
        if env.render_mode == "human" or np.shape(action) != (4,):  # draws, or raises
            return self._original_step(action)
        self.act(np.clip(action, env.action_space.low, env.action_space.high))
        mujoco.mj_step(env.model, env.data, nstep=env.n_substeps)
        env._step_callback()
        observation = self.observe()
        distance = _distance(observation["achieved_goal"], env.goal)
        reward: np.floating = -np.float64(distance)
        if env.reward_type == "sparse":
            reward = -np.float32(distance > env.distance_threshold)
        info = {"is_success": np.float32(distance < env.distance_threshold)}
        return observation, reward, False, False, info

    def act(self, action: np.ndarray) -> np.ndarray:
        """Set the controls and the body that leads the hand. Shapes: ``(4,)``."""
        if len(self._ctrl):  # there is none where the fingers stay closed
            fingers = 0.0 if self._env.block_gripper else action[3]
            self._ctrl[:] = self._lookups.present_controls(self._qpos) + fingers
        self._hand_place[:] = self._link_place + action[:3] * 0.05
        self._hand_turn[:] = self._link_turn + _TURN
        return action

    def observe(self) -> dict[str, np.ndarray]:
        """Return the observation."""
        model, data, qvel, time = self._env.model, self._env.data, self._qvel, self._time
        mujoco.mj_jacSite(model, data, self._grip_jacobian, None, self._grip)
        speed = self._grip_jacobian @ qvel * time
        fingers, finger_speeds = self._qpos[self._finger_places], qvel[self._finger_speeds] * time
        grip = achieved = self._grip_place
        if self._env.has_object:
            achieved = self._object_place
            moving, turning = self._object_jacobians
            mujoco.mj_jacSite(model, data, moving, turning, self._object)
            parts = [
                grip, achieved, achieved - grip, fingers, euler_angles(self._object_turn),
                moving @ qvel * time - speed, turning @ qvel * time, speed, finger_speeds,
            ]  # fmt: skip
        else:
            parts = [grip, fingers, speed, finger_speeds]
        return {
            "observation": np.concatenate(parts),
            "achieved_goal": achieved.copy(),
            "desired_goal": self._env.goal.copy(),
        }


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the Euclidean distance, summed in NumPy's order. Shapes: ``(3,)``."""
    x, y, z = (one - other).tolist()
    return math.sqrt(x * x + y * y + z * z)


def euler_angles(rotation: np.ndarray) -> np.ndarray:
    """Return the angles of ``gymnasium_robotics.utils.rotations.mat2euler``, in rad.

    Args:
        rotation: A rotation matrix in row order. Shapes: ``(9,)``; result: ``(3,)``.
    """
    xx, xy, xz, yx, yy, yz, _, _, zz = rotation.tolist()
    cosine = math.sqrt(zz * zz + yz * yz)
    if cosine > _SMALL:
        return -np.arctan2([yz, -xz, xy], [zz, cosine, xx])
    angles = -np.arctan2([0.0, -xz, -yx], [1.0, cosine, yy])
    angles[0] = 0.0
    return angles


class RememberedLookups:
    """The functions of ``gymnasium_robotics.utils.mujoco_utils`` for one model.

    Those that are not here are the original ones. The ``model`` of each call must be that of the
    constructor.

    Args:
        model: The MuJoCo model.
        original: The module that is replaced.

    Attributes:
        sites: Name to index.
        robot_places: Of the robot's joints in ``qpos``. Shapes: ``(n_joints,)``.
        robot_speeds: Of the robot's joints in ``qvel``. Shapes: ``(n_joints,)``.
        welds: Each mocap index with the body that follows it.
        has_one_hand: Whether one body leads the robot, which has two fingers at most.
    """

    def __init__(self, model: mujoco.MjModel, original: ModuleType) -> None:
        self._original = original
        self.sites = {model.site(i).name: i for i in range(model.nsite)}
        self._jacobian = np.zeros((3, model.nv))
        joints = [model.joint(i) for i in range(model.njnt)]
        self._places = {j.name: int(j.qposadr[0]) for j in joints if j.type[0] in _ONE_NUMBER}
        robot = [j for j in joints if j.name.startswith("robot")]
        self.robot_places = np.array([j.qposadr[0] for j in robot])
        self.robot_speeds = np.array([j.dofadr[0] for j in robot])
        self._n_mocap_numbers = 7 * model.nmocap
        self._is_relative = model.actuator_biastype != 0
        self._actuated = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self.welds = _welded_bodies(model)
        self.has_one_hand = len(self.welds) == model.nmocap == 1 and model.nu <= 2

    def __getattr__(self, name: str) -> object:
        """Return the original of a function that is not replaced."""
        return getattr(self._original, name)

    def robot_get_obs(
        self, model: mujoco.MjModel, data: mujoco.MjData, joint_names: object
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities of the robot's joints. Shapes: ``(n_joints,)`` each."""
        return data.qpos[self.robot_places], data.qvel[self.robot_speeds]

    def get_site_xpos(self, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
        """Return a site's place. Shapes: ``(3,)``."""
        return data.site_xpos[self.sites[name]]

    def get_site_xmat(self, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
        """Return a site's rotation. Shapes: ``(3, 3)``."""
        return data.site_xmat[self.sites[name]].reshape(3, 3)

    def get_site_xvelp(self, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
        """Return a site's velocity. Shapes: ``(3,)``."""
        mujoco.mj_jacSite(model, data, self._jacobian, None, self.sites[name])
        return self._jacobian @ data.qvel

    def get_site_xvelr(self, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
        """Return a site's angular velocity. Shapes: ``(3,)``."""
        mujoco.mj_jacSite(model, data, None, self._jacobian, self.sites[name])
        return self._jacobian @ data.qvel

    def set_joint_qpos(
        self, model: mujoco.MjModel, data: mujoco.MjData, name: str, value: object
    ) -> None:
        """Set the position of a joint."""
        if name in self._places:
            data.qpos[self._places[name]] = value
        else:
            self._original.set_joint_qpos(model, data, name, value)

    def ctrl_set_action(
        self, model: mujoco.MjModel, data: mujoco.MjData, action: np.ndarray
    ) -> None:
        """Set forces, or positions relative to the present ones."""
        action = action[self._n_mocap_numbers :][: model.nu]
        data.ctrl[: len(action)] = self.present_controls(data.qpos)[: len(action)] + action

    def present_controls(self, qpos: np.ndarray) -> np.ndarray:
        """Return what new controls are relative to. Shapes: ``(nu,)``."""
        return np.where(self._is_relative, qpos[self._actuated], 0.0)

    def mocap_set_action(
        self, model: mujoco.MjModel, data: mujoco.MjData, action: np.ndarray
    ) -> None:
        """Move the bodies that lead the robot relative to those that follow them."""
        movement = action[: self._n_mocap_numbers].reshape(-1, 7)
        for leader, follower in self.welds:
            data.mocap_pos[leader] = data.xpos[follower]
            data.mocap_quat[leader] = data.xquat[follower]
        data.mocap_pos[:] = data.mocap_pos + movement[:, :3]
        data.mocap_quat[:] = data.mocap_quat + movement[:, 3:]


def _welded_bodies(model: mujoco.MjModel) -> list[tuple[int, int]]:
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
