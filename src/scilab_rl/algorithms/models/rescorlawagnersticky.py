"""Rescorla-Wagner learning with choice stickiness: what was chosen last is chosen again.

Lau & Glimcher, 2005, J Exp Anal Behav 84; Gershman et al., 2009, J Neurosci 29. As
`rescorlawagner`, with a bonus kappa for the last response in this state, whatever it brought:

    learn    Q(a) <- Q(a) + alpha (r - Q(a))
    choose   P(a) proportional to exp(beta Q(a) + kappa [a was chosen last])

A negative kappa alternates.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from scilab_rl.learning.cognitive import (
    RATE,
    TEMPERATURE,
    Array,
    CognitiveModel,
    Memory,
    Parameter,
    Trial,
    Values,
)

INITIAL_VALUE = 0.5


class RESCORLAWAGNERSTICKY(CognitiveModel):
    """Learn values by prediction errors, and tend to repeat choices.

    Args:
        learning_rate: alpha, the share of a prediction error that is learned, from 0 to 1.
        inverse_temperature: beta; 0 ignores values.
        stickiness: kappa; positive repeats the last response, negative avoids it.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {
        "learning_rate": RATE,
        "inverse_temperature": TEMPERATURE,
        "stickiness": Parameter(mean=0.0, sd=1.0),
    }

    def __init__(
        self,
        *,
        learning_rate: float = 0.3,
        inverse_temperature: float = 5.0,
        stickiness: float = 0.5,
        **common: Any,
    ) -> None:
        super().__init__(
            learning_rate=learning_rate,
            inverse_temperature=inverse_temperature,
            stickiness=stickiness,
            **common,
        )

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return values without experience, and no last response.

        Shapes:
            both: ``(n_states, n_actions)``.
        """
        return {
            "values": jnp.full((n_states, n_actions), INITIAL_VALUE),
            "last": jnp.zeros((n_states, n_actions)),
        }

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Move the value of the chosen response towards the feedback, and remember the response."""
        values, (state, response) = memory["values"], trial[:2]
        error = trial.feedback - values[state, response]
        chosen = jax.nn.one_hot(response, values.shape[1])
        return {
            "values": values.at[state, response].add(parameters["learning_rate"] * error),
            "last": memory["last"].at[state].set(chosen),
        }

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return beta Q + kappa [a was chosen last]."""
        values, last = memory["values"][state], memory["last"][state]
        return parameters["inverse_temperature"] * values + parameters["stickiness"] * last
