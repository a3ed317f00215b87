"""Random actions, no learning: the baseline that every agent has to beat."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from scilab_rl.learning.base import OneFileAlgorithm


class RANDOM(OneFileAlgorithm):
    """Draws each action uniformly from the action space, also in `predict`."""

    supported_action_spaces = (
        spaces.Box,
        spaces.Discrete,
        spaces.MultiDiscrete,
        spaces.MultiBinary,
    )

    def iterate(self, callback: BaseCallback) -> bool:
        """Take one step in each environment."""
        callback.on_rollout_start()
        if self.step(self.sample_env_actions(), callback) is None:
            return False
        callback.on_rollout_end()
        return True

    def act(self, observations: torch.Tensor, deterministic: bool) -> torch.Tensor:
        """Choose actions at random, whether ``deterministic`` or not."""
        return torch.as_tensor(self.from_env_actions(self.sample_env_actions(len(observations))))
