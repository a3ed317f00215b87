"""Meta-World's 50 tasks for a Sawyer arm: the dense originals, and goal tasks for HER.

``MetaW-drawer-close-v3`` is the original reward with the goal observed. ``-sparse`` and ``-dense``
before the version make a goal task of it, for the tasks in `GOAL_TASKS`. The goal is drawn again at
each reset, unlike in Meta-World's own benchmarks, where it belongs to the instance; in the tasks of
`SAME_GOAL`, the place of the object is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from metaworld.env_dict import ALL_V3_ENVIRONMENTS

from scilab_rl.envs.goal import goal_distance, negative_distance, sparse_cost
from scilab_rl.envs.types import Info, ResetResult, StepResult

_ALL = (0, 1, 2)
_X, _Y, _Z = (0,), (1,), (2,)
_REWARDS = {"sparse": sparse_cost, "dense": negative_distance}
STEP_LIMIT = 500
_CAMERA = {"distance": 1.7, "azimuth": -45.0, "elevation": -30.0, "lookat": (0.0, 0.6, 0.15)}


@dataclass(frozen=True)
class GoalTask:
    """What has to be where, as Meta-World's own criterion of success has it.

    Attributes:
        threshold: Distance up to which the goal counts as reached, in m.
        axes: The axes on which the distance is measured.
        part: What is brought there: ``object``, ``gripper`` or the name of a site.
        offset: Added to its place, in m.
        scale: How much each axis counts; goals are in these units.
        height: Height of the goal, where it is not that of Meta-World's target, in m.
    """

    threshold: float
    axes: tuple[int, ...] = _ALL
    part: str = "object"
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    height: float | None = None


# One row per task whose success is a distance between a place in the observation and the target.
GOAL_TASKS = {
    "basketball": GoalTask(0.08, scale=(1.0, 1.0, 2.0), height=0.3),
    "bin-picking": GoalTask(0.05),
    "box-close": GoalTask(0.08),
    "button-press": GoalTask(0.02, _Y),
    "button-press-topdown": GoalTask(0.024, _Z),
    "button-press-topdown-wall": GoalTask(0.024, _Z),
    "button-press-wall": GoalTask(0.03, _Y),
    "coffee-button": GoalTask(0.02, _Y),
    "coffee-pull": GoalTask(0.07),
    "coffee-push": GoalTask(0.07),
    "dial-turn": GoalTask(0.07),
    "door-close": GoalTask(0.08),
    "door-lock": GoalTask(0.02, _Z),
    "door-open": GoalTask(0.08, _X),
    "door-unlock": GoalTask(0.02, _X),
    "drawer-close": GoalTask(0.065),
    "drawer-open": GoalTask(0.03, _Y),
    "faucet-close": GoalTask(0.07),
    "faucet-open": GoalTask(0.07, offset=(-0.04, 0.0, 0.03)),
    "hand-insert": GoalTask(0.05),
    "handle-press": GoalTask(0.02, _Z),
    "handle-press-side": GoalTask(0.02, _Z),
    "handle-pull": GoalTask(0.05, _Z),
    "handle-pull-side": GoalTask(0.08),
    "peg-insert-side": GoalTask(0.07, part="pegHead", scale=(1.0, 2.0, 2.0)),
    "peg-unplug-side": GoalTask(0.07),
    "pick-out-of-hole": GoalTask(0.07),
    "pick-place": GoalTask(0.07),
    "pick-place-wall": GoalTask(0.07),
    "plate-slide": GoalTask(0.07),
    "plate-slide-back": GoalTask(0.07),
    "plate-slide-back-side": GoalTask(0.07),
    "plate-slide-side": GoalTask(0.07),
    "push": GoalTask(0.05),
    "push-back": GoalTask(0.07),
    "push-wall": GoalTask(0.07),
    "reach": GoalTask(0.05, part="gripper"),
    "reach-wall": GoalTask(0.05, part="gripper"),
    "shelf-place": GoalTask(0.07),
    "soccer": GoalTask(0.07),
    "sweep": GoalTask(0.05),
    "sweep-into": GoalTask(0.05, (0, 1)),
    "window-close": GoalTask(0.05, _X),
    "window-open": GoalTask(0.05, _X),
}
# Here Meta-World draws where the object is; the goal, on the axes that count, is always the same.
SAME_GOAL = (
    "bin-picking", "button-press-topdown", "button-press-topdown-wall", "door-lock", "drawer-open",
    "sweep-into", "window-close",
)  # fmt: skip
# The others, and why HER has no goals to work with there.
WITHOUT_GOALS = {
    "assembly": "two bounds, for alignment and for height, not one distance",
    "disassemble": "a height to rise above, at any place",
    "hammer": "a depth that the nail has to exceed",
    "lever-pull": "the angle of a lever, not a place",
    "stick-pull": "the stick must also be inserted",
    "stick-push": "the stick must also be held",
}


class MetaWorld(gym.Env):
    """A task of Meta-World with its original reward, and a new goal at each reset.

    The observation is Meta-World's: gripper, objects, the same one step before, and the goal.

    Args:
        task: Its name without version, such as ``drawer-close``.
        render_mode: None, ``rgb_array`` or ``human``.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 80}  # noqa: RUF012 - Gymnasium's

    def __init__(self, task: str, render_mode: str | None = None) -> None:
        self.task = task
        self.render_mode = render_mode
        make: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]
        self.inner = make(render_mode=render_mode)
        # Meta-World's own cameras hang upside down or see half of the table.
        self.inner.mujoco_renderer = MujocoRenderer(
            self.inner.model, self.inner.data, _CAMERA, width=480, height=480, camera_id=-1
        )
        # What Meta-World's benchmarks set from outside: goals that are drawn and observed.
        self.inner._set_task_called = True
        self.inner._freeze_rand_vec = False
        self.inner.seeded_rand_vec = True
        self.inner._partially_observable = False
        # Remembered for hidden goals, it would clip the observed goal to zero.
        self.inner.__dict__.pop("sawyer_observation_space", None)
        # Places beyond the declared bounds do occur at the reset.
        self.observation_space: spaces.Space = spaces.Box(-np.inf, np.inf, (39,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model."""
        return self.inner.model

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state."""
        return self.inner.data

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin an episode with a new goal."""
        super().reset(seed=seed)
        self.inner.np_random = self.np_random  # one generator for all chance
        observation, _ = self.inner.reset()
        return observation, {"is_success": False}

    def step(self, action: np.ndarray) -> StepResult:
        """Act for one step."""
        observation, reward, _, _, info = self.inner.step(np.asarray(action, dtype=np.float32))
        success = bool(info["success"])
        return observation, float(reward), False, False, {**info, "is_success": success}

    def render(self) -> np.ndarray | None:
        """Return a frame."""
        return self.inner.render()

    def close(self) -> None:
        """Free the graphics memory."""
        self.inner.close()

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as a new environment with the same arguments."""
        return type(self), (self.task, self.render_mode)


class MetaWorldGoal(MetaWorld):
    """A task of Meta-World as a goal task, by its row in `GOAL_TASKS`.

    Args:
        task: Its name without version.
        reward_type: ``sparse`` (0 at the goal, else -1) or ``dense`` (minus the distance).
        render_mode: None, ``rgb_array`` or ``human``.
    """

    def __init__(
        self, task: str, reward_type: str = "sparse", render_mode: str | None = None
    ) -> None:
        super().__init__(task, render_mode)
        self.reward_type = reward_type
        self.goal_task = GOAL_TASKS[task]
        goal = spaces.Box(-np.inf, np.inf, (len(self.goal_task.axes),), np.float64)
        self.observation_space = spaces.Dict(
            observation=self.observation_space, achieved_goal=goal, desired_goal=goal
        )

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin an episode with a new goal.

        Meta-World's first observation shows objects where they were in the episode before, which
        would make some goals seem reached; here it is taken again.
        """
        super().reset(seed=seed, options=options)
        mujoco.mj_forward(self.model, self.data)
        now = self.inner._prev_obs = self.inner._get_curr_obs_combined_no_goal()
        observation = self._with_goals(np.hstack([now, now, self.inner._get_pos_goal()]))
        return observation, {"is_success": self._is_success(observation)}

    def step(self, action: np.ndarray) -> StepResult:
        """Act for one step; the original reward is kept as ``info["own_reward"]``."""
        vector, own_reward, terminated, truncated, info = super().step(action)
        observation = self._with_goals(vector)
        info = {**info, "is_success": self._is_success(observation), "own_reward": own_reward}
        goals = observation["achieved_goal"], observation["desired_goal"]
        return observation, float(self.compute_reward(*goals, info)), terminated, truncated, info

    def compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return the reward. Shapes: goals ``(..., n_axes)``, result ``(...)``."""
        distance = goal_distance(achieved_goal, desired_goal)
        return _REWARDS[self.reward_type](distance, self.goal_task.threshold)

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return False: reaching the goal does not end the episode. Shapes: as the reward's."""
        return np.zeros(np.shape(achieved_goal)[:-1], dtype=bool)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle as a new environment with the same arguments."""
        return type(self), (self.task, self.reward_type, self.render_mode)

    def _with_goals(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        row = self.goal_task
        axes, scale = list(row.axes), np.asarray(row.scale)
        target = np.array(self.inner._target_pos)
        if row.height is not None:
            target[2] = row.height
        return {
            "observation": vector,
            "achieved_goal": ((self._place(vector) + row.offset) * scale)[axes],
            "desired_goal": (target * scale)[axes],
        }

    def _place(self, vector: np.ndarray) -> np.ndarray:
        part = self.goal_task.part
        if part == "gripper":
            return self.inner.tcp_center
        return vector[4:7] if part == "object" else self.inner._get_site_pos(part)

    def _is_success(self, observation: dict[str, np.ndarray]) -> bool:
        difference = observation["achieved_goal"] - observation["desired_goal"]
        return bool(np.linalg.norm(difference) <= self.goal_task.threshold)


def register() -> None:
    """Register all tasks, and the goal tasks in both rewards."""
    for task in sorted(name.removesuffix("-v3") for name in ALL_V3_ENVIRONMENTS):
        _register(f"MetaW-{task}-v3", "MetaWorld", task=task)
        if task in GOAL_TASKS:
            for kind in _REWARDS:
                _register(f"MetaW-{task}-{kind}-v3", "MetaWorldGoal", task=task, reward_type=kind)


def _register(env_id: str, cls: str, **arguments: str) -> None:
    if env_id not in gym.registry:
        entry_point = f"{__name__}:{cls}"
        gym.register(env_id, entry_point, max_episode_steps=STEP_LIMIT, kwargs=arguments)
