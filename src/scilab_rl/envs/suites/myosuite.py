"""MyoSuite's tasks, which tell under another name whether they are solved."""

from __future__ import annotations

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils import RecordConstructorArgs

from scilab_rl.envs.types import StepResult


class Solved(gym.Wrapper, RecordConstructorArgs):
    """Tells ``info["is_success"]``, which evaluations count, from MyoSuite's ``solved``.

    Args:
        env: A task of MyoSuite.
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: object) -> StepResult:
        """Act for one step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        solved = bool(info.get("solved", False))
        return observation, float(reward), terminated, truncated, {**info, "is_success": solved}


def register() -> None:
    """Let ``gymnasium.make`` wrap each of MyoSuite's tasks."""
    solved = WrapperSpec("Solved", f"{__name__}:Solved", {})
    for spec in gym.registry.values():
        if str(spec.entry_point).startswith("myosuite.") and solved not in spec.additional_wrappers:
            spec.additional_wrappers = (*spec.additional_wrappers, solved)
