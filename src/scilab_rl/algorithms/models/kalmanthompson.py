"""Kalman filter for a bandit, choosing by Thompson's rule: as often as an arm is likely the best.

Thompson, 1933; as a model of random exploration Gershman, 2018, Cognition 173, and Speekenbrink &
Konstantinidis, 2015, Top Cogn Sci 7. Learning is that of `kalmanucb`; each arm is believed to have
a reward with mean m and variance v:

    gain     k = v(a) / (v(a) + observation_sd^2)
    learn    m(a) <- m(a) + k (r - m(a)),   v(a) <- (1 - k) v(a)
    forget   v    <- v + drift_sd^2, of all arms
    choose   P(a) = P(a draw for a is the largest of the draws from N(m, v))

For two arms that is Phi((m1 - m2) / sqrt(v1 + v2)); for more it is an integral over one dimension,
because the draws are independent, which is computed with 32 nodes (Gauss-Hermite).
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr

from scilab_rl.learning.cognitive import (
    Array,
    CognitiveModel,
    Memory,
    Parameter,
    Trial,
    Values,
)

INITIAL_MEAN, INITIAL_SD = 0.5, 0.3
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(32)
WEIGHTS = WEIGHTS / np.sqrt(2 * np.pi)  # of the standard normal density


class KALMANTHOMPSON(CognitiveModel):
    """Learn as fast as one is uncertain, and choose as if each belief were a lottery.

    Args:
        observation_sd: Standard deviation of a reward around its mean, as the model assumes it.
        drift_sd: Standard deviation of the change of a mean per trial, as it assumes it.
        **common: Environments, seed and device, see `OneFileAlgorithm`.
    """

    parameters: ClassVar = {
        "observation_sd": Parameter(0.0, mean=-1.0, sd=0.7),
        "drift_sd": Parameter(0.0, mean=-2.5, sd=0.7),
    }

    def __init__(
        self, *, observation_sd: float = 0.4, drift_sd: float = 0.1, **common: Any
    ) -> None:
        super().__init__(observation_sd=observation_sd, drift_sd=drift_sd, **common)

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
        """Return the logarithms of the probabilities that each arm's draw is the largest."""
        return log_largest(memory["mean"][state], memory["var"][state])


def log_largest(mean: Array, var: Array) -> Array:
    """Return the log-probabilities that a draw is the largest of independent Gaussian ones.

    Shapes:
        mean, var, result: ``(n,)``.
    """
    n = len(mean)
    if n == 2:
        distance = (mean[0] - mean[1]) / jnp.sqrt(var.sum())
        return log_ndtr(jnp.stack([distance, -distance]))
    sd = jnp.sqrt(var)
    # In the precision of the beliefs: a fit computes in float64, acting in float32.
    nodes, weights = NODES.astype(mean.dtype), WEIGHTS.astype(mean.dtype)
    draws = mean[:, None] + sd[:, None] * nodes
    below = log_ndtr((draws[:, None] - mean[None, :, None]) / sd[None, :, None])
    others = jnp.where(jnp.eye(n, dtype=bool)[..., None], 0.0, below).sum(axis=1)
    probabilities = (jnp.exp(others) * weights).sum(axis=1)
    return jnp.log(jnp.clip(probabilities, 1e-12))
