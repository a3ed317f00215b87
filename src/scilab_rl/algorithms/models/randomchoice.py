"""Random choice with a bias: what a participant does who does not learn.

Wilson & Collins, 2019, eLife 8, model 1. Feedback changes nothing:

    choose   P(a) proportional to exp(bias [a = 0])

A bias of 0 is chance. Each model that claims that somebody has learned should be compared with it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from scilab_rl.learning.cognitive import Array, CognitiveModel, Memory, Parameter, Trial, Values


class RANDOMCHOICE(CognitiveModel):
    """Choose at random, perhaps with a bias for the first response.

    Args:
        bias: Added to the log-odds of response 0; 0 is chance.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {"bias": Parameter(mean=0.0, sd=1.0)}

    def __init__(self, *, bias: float = 0.0, **common: Any) -> None:
        super().__init__(bias=bias, **common)

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return the preferences, which stay. Shapes: ``(n_actions,)``."""
        return jnp.zeros(n_actions).at[0].set(parameters["bias"])

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Learn nothing."""
        return memory

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return the preferences."""
        return memory
