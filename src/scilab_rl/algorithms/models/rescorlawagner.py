"""Rescorla-Wagner learning with a softmax: the first model of learning from feedback.

Rescorla & Wagner, 1972; as a model of choices, Sutton & Barto, 2018, chapter 2, and Wilson &
Collins, 2019, eLife 8, model 3. The value Q of the chosen response moves towards the feedback r:

    learn    Q(a) <- Q(a) + alpha (r - Q(a))
    choose   P(a) proportional to exp(beta Q(a))

Values begin at 0.5, the middle of feedback from 0 to 1. In tasks with several states, each has
values of its own.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from scilab_rl.learning.cognitive import (
    RATE,
    TEMPERATURE,
    Array,
    CognitiveModel,
    Memory,
    Trial,
    Values,
)

INITIAL_VALUE = 0.5


class RESCORLAWAGNER(CognitiveModel):
    """Learn values by prediction errors, choose the better ones more often.

    Args:
        learning_rate: alpha, the share of a prediction error that is learned, from 0 to 1.
        inverse_temperature: beta; 0 chooses at random, large values choose the best.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {"learning_rate": RATE, "inverse_temperature": TEMPERATURE}

    def __init__(
        self, *, learning_rate: float = 0.3, inverse_temperature: float = 5.0, **common: Any
    ) -> None:
        super().__init__(
            learning_rate=learning_rate, inverse_temperature=inverse_temperature, **common
        )

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return values without experience. Shapes: ``(n_states, n_actions)``."""
        return jnp.full((n_states, n_actions), INITIAL_VALUE)

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Move the value of the chosen response towards the feedback."""
        error = trial.feedback - memory[trial.state, trial.response]
        return memory.at[trial.state, trial.response].add(parameters["learning_rate"] * error)

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return beta Q."""
        return parameters["inverse_temperature"] * memory[state]
