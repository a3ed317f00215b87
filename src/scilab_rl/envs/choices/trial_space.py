"""The observations of choice tasks: where one is, and what the last choice has brought."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces


class TrialSpace(spaces.Box):
    """A vector: the present state, the last response (both one-hot) and its feedback.

    All zeros in place of the last response mean that a block begins: nothing is known. Feedback is
    part of the observation, so that networks without memory of their own can use the last trial.

    Args:
        n_states: States in which choices are made; 1 for a bandit.
        n_actions: Responses among which to choose.
        n_stages: Choices per trial; 2 if a first choice only leads to a second one.
    """

    def __init__(self, n_states: int, n_actions: int, n_stages: int = 1) -> None:
        self.n_states, self.n_actions, self.n_stages = n_states, n_actions, n_stages
        super().__init__(-1.0, 1.0, (n_states + n_actions + 1,), np.float32)

    def encode(self, state: int, response: int | None, feedback: float) -> np.ndarray:
        """Return an observation.

        Args:
            state: The present one, from 0.
            response: The last one, from 0; None at the beginning of a block.
            feedback: What it has brought, in [-1, 1].

        Shapes:
            result: ``(n_states + n_actions + 1,)``.
        """
        vector = np.zeros(self.shape, np.float32)
        vector[state] = 1.0
        if response is not None:
            vector[self.n_states + response] = 1.0
            vector[-1] = feedback
        return vector

    def decode(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the present states, the last responses (-1: none) and their feedback.

        Shapes:
            observations: ``(..., n_states + n_actions + 1)``; results: ``(...)``.
        """
        observations = np.asarray(observations)
        responses = observations[..., self.n_states : -1]
        last = np.where(responses.any(-1), responses.argmax(-1), -1)
        return observations[..., : self.n_states].argmax(-1), last, observations[..., -1]
