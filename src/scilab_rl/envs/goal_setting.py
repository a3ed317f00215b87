"""Beginning an episode with a chosen desired goal, in any environment with goals.

Our own tasks take ``reset(options={"desired_goal": goal})``. Those of Gymnasium-Robotics and
panda-gym draw the goal in ``_sample_goal``, which answers with the chosen one for one reset. Where
there is only an attribute ``goal``, it is replaced after the reset, and so is the observation's.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.types import Info, ResetResult

OPTION = "desired_goal"


class EpisodePlan(NamedTuple):
    """How an episode begins.

    Attributes:
        seed: Of the reset; None: the environment's chance continues.
        goal: The desired goal; None: the environment draws one. Shapes: ``(*goal_shape)``.
    """

    seed: int | None = None
    goal: np.ndarray | None = None

    @property
    def options(self) -> Info | None:
        """The options of the reset."""
        return None if self.goal is None else {OPTION: self.goal}


def reset_with_goal(env: gym.Env, *, seed: int | None, options: Info | None) -> ResetResult:
    """Reset an environment, with the desired goal that the options name, if they name one.

    Start states are those of the same seed without a chosen goal, wherever the environment draws
    its goal last: the goal is drawn and then replaced.
    """
    chosen = None if options is None else options.get(OPTION)
    found = None if chosen is None else _goal_owner(env)
    if found is None:
        return env.reset(seed=seed, options=options)
    owner, name = found
    goal = np.asarray(chosen)
    rest = {key: value for key, value in (options or {}).items() if key != OPTION} or None
    if callable(getattr(owner, "_sample_goal", None)):
        with _sampled(owner, goal):
            return env.reset(seed=seed, options=rest)
    observation, info = env.reset(seed=seed, options=rest)
    drawn = getattr(owner, name)
    setattr(owner, name, goal.astype(drawn.dtype).reshape(drawn.shape))
    if callable(show := getattr(owner, "update_target_site_pos", None)):
        show()
    return {**observation, OPTION: getattr(owner, name).copy()}, info


def _goal_owner(env: gym.Env) -> tuple[Any, str] | None:
    """Return whose attribute must be replaced, and its name; None where the option does it all."""
    inner: Any = env.unwrapped
    if isinstance(inner, GoalEnv):
        return None
    for owner in (inner, getattr(inner, "task", None)):  # panda-gym's goal belongs to its task
        for name in ("goal", "_goal"):
            if isinstance(getattr(owner, name, None), np.ndarray):
                return owner, name
    return None


@contextlib.contextmanager
def _sampled(owner: Any, goal: np.ndarray) -> Iterator[None]:
    """Let an object's ``_sample_goal`` return this goal."""
    original = owner._sample_goal

    def sample_goal() -> np.ndarray:
        drawn = np.asarray(original())  # so that later chance is the same
        return goal.astype(drawn.dtype).reshape(drawn.shape)

    owner._sample_goal = sample_goal
    try:
        yield
    finally:
        del owner._sample_goal
