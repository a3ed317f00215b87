"""How often the simulation became unstable while the agent learned, and what led to it."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from scilab_rl.envs.stability import STATES_KEY, UNSTABLE_KEY
from scilab_rl.envs.vec_step import ObservedStep

_log = logging.getLogger(__name__)
_MAX_FILES = 20


class InstabilityRecord:
    """Observes training steps, counts unstable episodes and keeps the states that led to them.

    Args:
        folder: Where ``step-000123-env0.npy`` is written, for at most 20 episodes.

    Attributes:
        n_episodes: How many episodes became unstable.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.n_episodes = 0

    def on_step(self, step: ObservedStep) -> None:
        """Look at a step of all environments."""
        for index in np.flatnonzero(step.dones):
            info = step.infos[int(index)]
            states = info.pop(STATES_KEY, None)
            if info.get(UNSTABLE_KEY):
                self.n_episodes += 1
                self._keep(states, f"step-{step.step:06d}-env{index}.npy")

    def metrics(self) -> dict[str, float]:
        """Return ``env/unstable_episodes`` if there were any."""
        return {"env/unstable_episodes": float(self.n_episodes)} if self.n_episodes else {}

    def _keep(self, states: np.ndarray | None, name: str) -> None:
        if states is None or self.n_episodes > _MAX_FILES:
            return
        try:
            self.folder.mkdir(exist_ok=True)
            np.save(self.folder / name, states, allow_pickle=False)
        except OSError as error:
            _log.warning("%s could not be saved: %s. Training continues.", name, error)
