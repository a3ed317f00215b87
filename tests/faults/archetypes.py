"""Kinds of tasks that differ in what is seen and what is done; in `Left` alone can be learned."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

_PLACE = spaces.Box(-1.0, 1.0, (2,), np.float32)
_GOALS = spaces.Dict({"observation": _PLACE, "achieved_goal": _PLACE, "desired_goal": _PLACE})
_PARTS = spaces.Dict({"place": _PLACE, "kind": spaces.Discrete(3)})
_PICTURE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
_MOVE, _CHOICE = spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Discrete(3)

_ODD_PARTS = spaces.Dict(
    {
        "hour": spaces.Discrete(19, start=2),
        "dice": spaces.MultiDiscrete([[6, 6]], start=[[1, 1]]),
        "light": spaces.Box(0.0, 1.0, (), np.float64),
        "board": spaces.Box(0, 1, (2, 2, 1), np.uint8),
    }
)
_UNREADABLE = {
    "Text": spaces.Text(9),
    "Sequence": spaces.Sequence(_CHOICE),
    "Graph": spaces.Graph(_PLACE, None),
    "OneOf": spaces.OneOf([_PLACE, _CHOICE]),
    "Dict": spaces.Dict({"inner": _PLACE}),
    "Tuple": spaces.Tuple([_PLACE, _CHOICE]),
}

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
    "BytesMove-v0": (spaces.Box(0, 1, (4,), np.uint8), spaces.Box(-128, 127, (2,), np.int8)),
    "LockedMove-v0": (
        spaces.Box(-1.0, 1.0, (), np.float32),
        spaces.Box(np.float32([-0.7, 2.0]), np.float32([0.1, 2.0])),
    ),
    "DottedMove-v0": (spaces.Dict({"robot.arm": _PLACE, "type": _PLACE}), _MOVE),
    "OddPartsChoice-v0": (_ODD_PARTS, spaces.Discrete(3, start=-1)),
    "DiceChoices-v0": (_ODD_PARTS["dice"], spaces.MultiDiscrete([6, 6], start=[1, 1])),
    # No algorithm reads these.
    **{
        f"{kind}Choice-v0": (spaces.Dict({"deep": space}) if kind == "Dict" else space, _CHOICE)
        for kind, space in _UNREADABLE.items()
    },
    **{
        f"{kind}EntryMove-v0": (spaces.Dict({"odd": space, "place": _PLACE}), _MOVE)
        for kind, space in _UNREADABLE.items()
    },
}


class Archetype(gym.Env):
    """Draws observations and rewards by chance.

    Args:
        name: One of `ARCHETYPES`.
        bound: Limit of the actions in each dimension, in the place of theirs.
    """

    def __init__(self, name: str, bound: float | None = None) -> None:
        self.observation_space, self.action_space = copy.deepcopy(ARCHETYPES[name])
        if bound is not None:
            self.action_space = spaces.Box(-bound, bound, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(np.asarray(action)), action
        return self.observation_space.sample(), float(self.np_random.random()), False, False, {}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1).astype(np.float32)

    compute_terminated = staticmethod(lambda achieved_goal, desired_goal, info: False)
    compute_truncated = staticmethod(lambda achieved_goal, desired_goal, info: False)


class Left(Archetype):
    """-1 is left, 0 is wait, 1 is right; left is paid."""

    def __init__(self) -> None:
        super().__init__("OddPartsChoice-v0")

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), -float(action), False, False, {}


for _name in ARCHETYPES:
    gym.register(_name, f"{__name__}:Archetype", max_episode_steps=10, kwargs={"name": _name})
gym.register("Endless-v0", f"{__name__}:Archetype", kwargs={"name": "GoalMove-v0"})
gym.register(
    "Boundless-v0", f"{__name__}:Archetype", max_episode_steps=10,
    kwargs={"name": "VectorMove-v0", "bound": np.inf},
)  # fmt: skip
gym.register(
    "Huge-v0", f"{__name__}:Archetype", max_episode_steps=10,
    kwargs={"name": "VectorMove-v0", "bound": np.finfo(np.float32).max / 2},
)  # fmt: skip
gym.register("Left-v0", f"{__name__}:Left", max_episode_steps=10)
