"""The units of an environment's numbers and how often it acts, which a robot must know.

An environment may say its units itself, by the entries of the observation and ``action``, such as
``metadata["units"] = {"observation": "m", "action": "N"}``; a single array is ``observation``.
"""

from __future__ import annotations

from collections.abc import Mapping

import gymnasium as gym

_FETCH = {
    "observation": "positions in m, Euler angles in rad, velocities in m or rad per step",
    "achieved_goal": "m",
    "desired_goal": "m",
    "action": "0.05 m per axis and step; fingers: 1 opens, -1 closes",
}


def units_of(env: gym.Env) -> Mapping[str, str]:
    """Return the units of the entries and of ``action``; what is not known is left out."""
    task = env.unwrapped
    if type(task).__module__.startswith("gymnasium_robotics.envs.fetch"):
        return _FETCH
    return (task.metadata or {}).get("units", {})


def control_frequency(env: gym.Env) -> float | None:
    """Return how many actions per second the environment simulates; None if it does not say."""
    for name in ("dt", "tau"):  # MuJoCo's environments; those of classic control
        seconds = getattr(env.unwrapped, name, None)
        if isinstance(seconds, (int, float)) and seconds > 0:
            return round(1.0 / seconds, 6)
    return None
