"""Highlights of an episode."""

from __future__ import annotations

import numpy as np

from scilab_rl.metrics.probes import Observation

FALL_METRES = 0.2  # a Fetch block on the floor is 0.4 m lower, a gripper cannot go as deep as 0.2 m


class EpisodeEvents:
    """Says what can be seen in each scene of an episode for the first time.

    Args:
        in_space: Whether the environment simulates bodies in space. Elsewhere, each third number
            of a goal is not a height: a car's goal has velocities and an orientation.
    """

    def __init__(self, *, in_space: bool) -> None:
        self._in_space = in_space
        self._first_heights: np.ndarray | None = None
        self._succeeded = False
        self._fell = False

    def of_scene(self, observation: Observation, success: bool | None) -> list[str]:
        """Return the events of a scene.

        Args:
            observation: What the agent sees.
            success: Whether the step before led to success; None for the first scene.
        """
        events = ["episode start"] if self._first_heights is None else []
        heights = _heights(observation) if self._in_space else np.zeros(0)
        if self._first_heights is None:
            self._first_heights = heights
        if success is not None and success != self._succeeded:
            events.append("success" if success else "success lost")
            self._succeeded = success
        if not self._fell and np.any(self._first_heights - heights > FALL_METRES):
            events.append("object fell")
            self._fell = True
        return events


def _heights(observation: Observation) -> np.ndarray:
    """Return the heights of the achieved goal's places in space, if that is what it consists of."""
    if not isinstance(observation, dict) or "achieved_goal" not in observation:
        return np.zeros(0)
    places = np.asarray(observation["achieved_goal"], dtype=np.float64).ravel()
    return places[2::3] if len(places) and len(places) % 3 == 0 else np.zeros(0)
