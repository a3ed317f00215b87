"""Rescorla-Wagner learning with two learning rates: one for gains, one for losses.

Frank et al., 2007, PNAS 104; den Ouden et al., 2013, Neuron 80. As `rescorlawagner`, but a positive
prediction error is learned with another rate than a negative one:

    learn    Q(a) <- Q(a) + alpha_gain  (r - Q(a))   if r > Q(a)
             Q(a) <- Q(a) + alpha_loss  (r - Q(a))   otherwise
    choose   P(a) proportional to exp(beta Q(a))
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


class RESCORLAWAGNER2(CognitiveModel):
    """Learn from gains and losses with different rates.

    Args:
        learning_rate_gain: Of positive prediction errors, from 0 to 1.
        learning_rate_loss: Of negative ones, from 0 to 1.
        inverse_temperature: beta; 0 chooses at random, large values choose the best.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {
        "learning_rate_gain": RATE,
        "learning_rate_loss": RATE,
        "inverse_temperature": TEMPERATURE,
    }

    def __init__(
        self,
        *,
        learning_rate_gain: float = 0.4,
        learning_rate_loss: float = 0.2,
        inverse_temperature: float = 5.0,
        **common: Any,
    ) -> None:
        super().__init__(
            learning_rate_gain=learning_rate_gain,
            learning_rate_loss=learning_rate_loss,
            inverse_temperature=inverse_temperature,
            **common,
        )

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return values without experience. Shapes: ``(n_states, n_actions)``."""
        return jnp.full((n_states, n_actions), INITIAL_VALUE)

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Move the value of the chosen response towards the feedback, by the rate of its sign."""
        error = trial.feedback - memory[trial.state, trial.response]
        gain, loss = parameters["learning_rate_gain"], parameters["learning_rate_loss"]
        rate = jnp.where(error > 0, gain, loss)
        return memory.at[trial.state, trial.response].add(rate * error)

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return beta Q."""
        return parameters["inverse_temperature"] * memory[state]
