"""The parking task of highway-env with episodes of 100 steps."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
from highway_env.envs.common.observation import KinematicsGoalObservation
from highway_env.envs.parking_env import ParkingEnv

from scilab_rl.envs.types import Info


class GoalObservation(KinematicsGoalObservation):
    """The car and its goal as numbers, without the tables of pandas in between.

    They took nine tenths of a step, in which there are four observations.
    """

    def observe(self) -> dict[str, np.ndarray]:
        """Return what the original returns, to the last bit."""
        car = self.observer_vehicle
        if not car:
            return super().observe()
        now, goal = (
            np.array([known[feature] for feature in self.features], dtype=np.float64) / self.scales
            for known in (car.to_dict(), car.goal.to_dict())
        )
        return {"observation": now, "achieved_goal": now.copy(), "desired_goal": goal}


class Parking(ParkingEnv):
    """highway-env's parking, whose reward and ending can be computed for relabeled goals too.

    The original adds the cost of a collision in `step` alone, and has no ``compute_terminated``.
    """

    def define_spaces(self) -> None:
        """Set spaces and observations as the original does, the latter in our quick form."""
        super().define_spaces()
        self.observation_type_parking = GoalObservation(self, **self.PARKING_OBS["observation"])
        if self.config["observation"]["type"] == "KinematicsGoal":
            self.observation_type = GoalObservation(self, **self.config["observation"])

    def compute_reward(
        self,
        achieved_goal: np.ndarray,
        desired_goal: np.ndarray,
        info: Info | Sequence[Info],
        p: float = 0.5,
    ) -> np.ndarray:
        """Return the proximity to the goal, minus the cost of a crash that the info tells of.

        Shapes:
            achieved_goal, desired_goal: ``(..., 6)``; info: one dictionary or ``(n,)`` of them.
        """
        difference = np.abs(np.asarray(achieved_goal) - np.asarray(desired_goal))
        cost = np.power(difference @ np.asarray(self.config["reward_weights"]), p)
        return self.config["collision_reward"] * _crashed(info) - cost

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Info | Sequence[Info]
    ) -> np.ndarray:
        """Return whether the car is parked or has crashed. Shapes: as `compute_reward`."""
        proximity = ParkingEnv.compute_reward(self, achieved_goal, desired_goal, {})
        return (proximity > -self.config["success_goal_reward"]) | (_crashed(info) > 0)


def register() -> None:
    """Register ``parking-limited-v0``."""
    if "parking-limited-v0" not in gym.registry:
        entry_point = f"{__name__}:Parking"
        gym.register("parking-limited-v0", entry_point=entry_point, max_episode_steps=100)


def _crashed(info: Info | Sequence[Info]) -> float | np.ndarray:
    """Return 1 where the car has crashed. Shapes: ``()`` or ``(n,)``."""
    if isinstance(info, dict):
        return float(info.get("crashed", False))
    return np.array([float(entry.get("crashed", False)) for entry in info])
