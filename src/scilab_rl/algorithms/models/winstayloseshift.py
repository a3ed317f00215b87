"""Win-stay, lose-shift, with noise: repeat what has paid, else try something else.

Robbins, 1952; as a model of choices, Wilson & Collins, 2019, eLife 8, model 2, here with a
probability of its own for each side:

    after a win    P(the same) = p_stay_win
    after a loss   P(another)  = p_shift_loss, the same for each other response

A win is feedback above 0.5. Only the last trial in a state counts, and before it all responses are
equal.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from scilab_rl.learning.cognitive import (
    Array,
    CognitiveModel,
    Memory,
    Parameter,
    Trial,
    Values,
)

WIN = 0.5


class WINSTAYLOSESHIFT(CognitiveModel):
    """Repeat a response that has won, and leave one that has lost.

    Args:
        p_stay_win: Probability of repeating a response that has won.
        p_shift_loss: Probability of leaving a response that has lost.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {
        "p_stay_win": Parameter(0.0, 1.0, mean=1.0, sd=1.5),
        "p_shift_loss": Parameter(0.0, 1.0, mean=0.0, sd=1.5),
    }

    def __init__(
        self, *, p_stay_win: float = 0.9, p_shift_loss: float = 0.6, **common: Any
    ) -> None:
        super().__init__(p_stay_win=p_stay_win, p_shift_loss=p_shift_loss, **common)

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return equal probabilities. Shapes: ``(n_states, n_actions)``."""
        return jnp.full((n_states, n_actions), 1.0 / n_actions)

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Return the probabilities of the next responses."""
        n_actions = memory.shape[1]
        stay_win, shift_loss = parameters["p_stay_win"], parameters["p_shift_loss"]
        stay = jnp.where(trial.feedback > WIN, stay_win, 1.0 - shift_loss)
        same = jax.nn.one_hot(trial.response, n_actions)
        probabilities = same * stay + (1.0 - same) * (1.0 - stay) / (n_actions - 1)
        return memory.at[trial.state].set(probabilities)

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return the logarithms of the probabilities."""
        return jnp.log(jnp.clip(memory[state], 1e-12))
