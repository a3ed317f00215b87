"""Tasks that report success in unusual ways, and tasks whose rewards need more than goals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

MODULE = "tests.faults.reporting"
LENGTH = 20
# What the info of a step says, by the step's number and the episode's.
CASES: dict[str, Callable[[int, int], Any]] = {
    "nan": lambda step, episode: float("nan"),
    "words": lambda step, episode: "False",
    "half": lambda step, episode: 0.5,
    "two": lambda step, episode: np.array([True, False]),
    "array": lambda step, episode: np.array([step == LENGTH]),
    "float": lambda step, episode: np.float32(step == LENGTH),
    "end": lambda step, episode: episode % 2 == 0 if step == LENGTH else None,
    "rarely": lambda step, episode: True if step == LENGTH and episode % 2 == 0 else None,
    "midway": lambda step, episode: True if step == 5 else None,
}


class Reporting(gym.Env):
    """Reports success as ``case`` says; None is left out of the info."""

    def __init__(self, case: str) -> None:
        self.case = str(case)  # the command line reads nan as a number
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.episode = -1

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        self.n_steps = 0
        self.episode += 1
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self.n_steps += 1
        told = CASES[self.case](self.n_steps, self.episode)
        info = {} if told is None else {"is_success": told}
        return np.zeros(2, np.float32), -1.0, False, False, info


class Effort(gym.Env):
    """A point with a goal whose reward has a cost that only the infos of steps know.

    Args:
        kind: ``required``; ``optional``, without it the cost is 0; ``single``, for one pair of
            goals; ``array``, an entry that is no number.
    """

    def __init__(self, kind: str = "required") -> None:
        self.kind = kind
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(keys, box))
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        self.place = np.zeros(2, np.float32)
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.observe(), {}

    def observe(self) -> dict[str, np.ndarray]:
        place, goal = self.place.copy(), self.goal.copy()
        return {"observation": place, "achieved_goal": place.copy(), "desired_goal": goal}

    def step(self, action: Any) -> Any:
        self.place = self.place + 0.2 * np.asarray(action, np.float32)
        effort: Any = np.array([0.25, 0.0]) if self.kind == "array" else 0.25
        near = bool(np.linalg.norm(self.place - self.goal) < 0.1)
        info = {"is_success": near, "effort": effort}
        reward = self.compute_reward(self.place, self.goal, info)
        return self.observe(), float(reward), False, False, info

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        if self.kind == "single":
            far = 1.0 if np.linalg.norm(achieved - desired) > 0.1 else 0.0
            return -far - info["effort"]
        far = (np.linalg.norm(achieved - desired, axis=-1) > 0.1).astype(np.float32)
        if isinstance(info, dict):
            return -far - np.sum(self.effort_of(info))
        return -far - np.array([np.sum(self.effort_of(entry)) for entry in info])

    def effort_of(self, info: dict[str, Any]) -> Any:
        return info.get("effort", 0.0) if self.kind == "optional" else info["effort"]


gym.register("Reporting-v0", entry_point=Reporting, max_episode_steps=LENGTH)
gym.register("Effort-v0", entry_point=Effort, max_episode_steps=LENGTH)
