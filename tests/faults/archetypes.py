"""Eight kinds of tasks that differ in what is seen and what is done; nothing can be learned."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

_PLACE = spaces.Box(-1.0, 1.0, (2,), np.float32)
_GOALS = spaces.Dict({"observation": _PLACE, "achieved_goal": _PLACE, "desired_goal": _PLACE})
_PARTS = spaces.Dict({"place": _PLACE, "kind": spaces.Discrete(3)})
_PICTURE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
_MOVE, _CHOICE = spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Discrete(3)

# name -> (what is seen, what is done)
ARCHETYPES: dict[str, tuple[spaces.Space, spaces.Space]] = {
    "VectorMove-v0": (_PLACE, _MOVE),
    "VectorChoice-v0": (_PLACE, _CHOICE),
    "GoalMove-v0": (_GOALS, _MOVE),
    "GoalChoice-v0": (_GOALS, _CHOICE),
    "PictureChoice-v0": (_PICTURE, _CHOICE),
    "PartsMove-v0": (_PARTS, _MOVE),
    "NumberChoice-v0": (spaces.Discrete(5), _CHOICE),
    "VectorChoices-v0": (_PLACE, spaces.MultiDiscrete([2, 3])),
    "VectorSwitches-v0": (_PLACE, spaces.MultiBinary(3)),
    "VectorParts-v0": (_PLACE, spaces.Dict({"move": _MOVE, "choice": _CHOICE})),
}


class Archetype(gym.Env):
    """Draws observations and rewards by chance.

    Args:
        name: One of `ARCHETYPES`.
        bounded: Whether actions have limits.
    """

    def __init__(self, name: str, bounded: bool = True) -> None:
        self.observation_space, self.action_space = ARCHETYPES[name]
        if not bounded:
            self.action_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), float(self.np_random.random()), False, False, {}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1).astype(np.float32)

    compute_terminated = staticmethod(lambda achieved_goal, desired_goal, info: False)
    compute_truncated = staticmethod(lambda achieved_goal, desired_goal, info: False)


for _name in ARCHETYPES:
    gym.register(_name, f"{__name__}:Archetype", max_episode_steps=10, kwargs={"name": _name})
gym.register("Endless-v0", f"{__name__}:Archetype", kwargs={"name": "GoalMove-v0"})
gym.register(
    "Boundless-v0", f"{__name__}:Archetype", max_episode_steps=10,
    kwargs={"name": "VectorMove-v0", "bounded": False},
)  # fmt: skip
