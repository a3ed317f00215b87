"""Kalman filter for a bandit, choosing by value plus a bonus for what is uncertain.

Daw et al., 2006, Nature 441; Speekenbrink & Konstantinidis, 2015, Top Cogn Sci 7; with the bonus of
Gershman, 2018, Cognition 173 (upper confidence bound, directed exploration). Each arm has a mean m
and a variance v, which are those of the reward if it is a Gaussian random walk:

    gain     k = v(a) / (v(a) + observation_sd^2)
    learn    m(a) <- m(a) + k (r - m(a)),   v(a) <- (1 - k) v(a)
    forget   v    <- v + drift_sd^2, of all arms
    choose   P(a) proportional to exp(beta (m(a) + bonus sqrt(v(a))))

The gain is a learning rate that falls while an arm becomes known. Without a drift it ends at 0.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from scilab_rl.learning.cognitive import (
    TEMPERATURE,
    Array,
    CognitiveModel,
    Memory,
    Parameter,
    Trial,
    Values,
)

INITIAL_MEAN, INITIAL_SD = 0.5, 0.3


class KALMANUCB(CognitiveModel):
    """Learn as fast as one is uncertain, and explore what is uncertain.

    Args:
        observation_sd: Standard deviation of a reward around its mean, as the model assumes it.
        drift_sd: Standard deviation of the change of a mean per trial, as it assumes it.
        inverse_temperature: beta; 0 chooses at random.
        uncertainty_bonus: What a standard deviation is worth; negative avoids the unknown.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {
        "observation_sd": Parameter(0.0, mean=-1.0, sd=0.7),
        "drift_sd": Parameter(0.0, mean=-2.5, sd=0.7),
        "inverse_temperature": TEMPERATURE,
        "uncertainty_bonus": Parameter(mean=0.0, sd=1.0),
    }

    def __init__(
        self,
        *,
        observation_sd: float = 0.4,
        drift_sd: float = 0.1,
        inverse_temperature: float = 5.0,
        uncertainty_bonus: float = 0.5,
        **common: Any,
    ) -> None:
        super().__init__(
            observation_sd=observation_sd,
            drift_sd=drift_sd,
            inverse_temperature=inverse_temperature,
            uncertainty_bonus=uncertainty_bonus,
            **common,
        )

    @staticmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return means and variances without experience. Shapes: ``(n_states, n_actions)``."""
        shape = (n_states, n_actions)
        return {"mean": jnp.full(shape, INITIAL_MEAN), "var": jnp.full(shape, INITIAL_SD**2)}

    @staticmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Filter the reward of the chosen arm; all arms become a bit less known."""
        place = trial.state, trial.response
        mean, var = memory["mean"], memory["var"]
        gain = var[place] / (var[place] + parameters["observation_sd"] ** 2)
        var = var.at[place].multiply(1.0 - gain)
        return {
            "mean": mean.at[place].add(gain * (trial.feedback - mean[place])),
            "var": var + parameters["drift_sd"] ** 2,
        }

    @staticmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return beta (m + bonus sqrt(v))."""
        bonus = parameters["uncertainty_bonus"] * jnp.sqrt(memory["var"][state])
        return parameters["inverse_temperature"] * (memory["mean"][state] + bonus)
