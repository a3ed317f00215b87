"""Hybrid of planning and habit for the two-step task.

Daw et al., 2011, Neuron 69. Habit (model-free, SARSA(lambda)) learns values of both choices from
what they have brought; planning (model-based) computes the values of the first choice from those of
the second and the known transitions, of which the common one has probability 0.7:

    learn    Q1(a1) <- Q1(a1) + alpha1 (Q2(s, a2) - Q1(a1)) + alpha1 lambda (r - Q2(s, a2))
             Q2(s, a2) <- Q2(s, a2) + alpha2 (r - Q2(s, a2))
    plan     Q_MB(a1) = 0.7 max Q2(common(a1)) + 0.3 max Q2(rare(a1))
    choose   first:  P(a) prop. to exp(beta1 (w Q_MB + (1 - w) Q1 + p [a chosen last]))
             second: P(a) prop. to exp(beta2 Q2(s, a))

Values begin at 0. w is 1 for a planner and 0 for habit.
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

P_COMMON = 0.7
FIRST = 0  # the state of the first choice


class HYBRID(CognitiveModel):
    """Mix the values of planning and habit.

    Args:
        learning_rate_1: alpha1, of the first choice's values, from 0 to 1.
        learning_rate_2: alpha2, of the second choice's values, from 0 to 1.
        inverse_temperature_1: beta1, of the first choice.
        inverse_temperature_2: beta2, of the second choice.
        eligibility: lambda, the share of the second prediction error that reaches the first choice.
        model_based_weight: w, from 0 (habit) to 1 (planning).
        stickiness: p, the worth of the last first choice; negative alternates.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    n_stages = 2
    parameters: ClassVar = {
        "learning_rate_1": RATE,
        "learning_rate_2": RATE,
        "inverse_temperature_1": TEMPERATURE,
        "inverse_temperature_2": TEMPERATURE,
        "eligibility": RATE,
        "model_based_weight": RATE,
        "stickiness": Parameter(mean=0.0, sd=0.3),
    }

    def __init__(
        self,
        *,
        learning_rate_1: float = 0.5,
        learning_rate_2: float = 0.4,
        inverse_temperature_1: float = 5.0,
        inverse_temperature_2: float = 4.0,
        eligibility: float = 0.6,
        model_based_weight: float = 0.4,
        stickiness: float = 0.1,
        **common: Any,
    ) -> None:
        super().__init__(
            learning_rate_1=learning_rate_1,
            learning_rate_2=learning_rate_2,
            inverse_temperature_1=inverse_temperature_1,
            inverse_temperature_2=inverse_temperature_2,
            eligibility=eligibility,
            model_based_weight=model_based_weight,
            stickiness=stickiness,
            **common,
        )

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return values without experience, and no first choice.

        Shapes:
            first, last: ``(2,)``, of the first choice; second: ``(2, 2)``, by planet and response;
            response: ``()``, the first choice of the running trial.
        """
        return {
            "first": jnp.zeros(2),
            "second": jnp.zeros((2, 2)),
            "last": jnp.zeros(2),
            "response": jnp.zeros((), int),
        }

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Remember a first choice; learn from the trial after the second one."""
        chosen = {"last": jax.nn.one_hot(trial.response, 2), "response": trial.response}
        after_first = memory | chosen
        first, second, response = memory["first"], memory["second"], memory["response"]
        place = trial.state - 1, trial.response
        error_1 = second[place] - first[response]
        error_2 = trial.feedback - second[place]
        step = error_1 + parameters["eligibility"] * error_2
        after_second = memory | {
            "first": first.at[response].add(parameters["learning_rate_1"] * step),
            "second": second.at[place].add(parameters["learning_rate_2"] * error_2),
        }
        is_first = trial.state == FIRST
        return jax.tree.map(lambda a, b: jnp.where(is_first, a, b), after_first, after_second)

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return the preferences of the first choice, or of the second one."""
        best = memory["second"].max(axis=1)
        planned = P_COMMON * best + (1.0 - P_COMMON) * best[::-1]
        weight = parameters["model_based_weight"]
        mixed = weight * planned + (1.0 - weight) * memory["first"]
        mixed = mixed + parameters["stickiness"] * memory["last"]
        first = parameters["inverse_temperature_1"] * mixed
        second = parameters["inverse_temperature_2"] * memory["second"][state - 1]
        return jnp.where(state == FIRST, first, second)
