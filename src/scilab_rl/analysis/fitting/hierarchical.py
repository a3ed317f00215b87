"""Hierarchical Bayesian estimates: participants come from a population whose mean is estimated too.

The real-scale parameters of participants are normal around a group mean, with priors on both; NUTS
(Hoffman & Gelman, 2014, JMLR 15) of NumPyro samples all of them. Participants are written as
mean + sd * z, with standard normal z, which samples well also where a participant says little.
R-hat and effective sizes are those of Vehtari et al. (2021, Bayesian Analysis 16), per split chain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from scilab_rl.analysis.fitting.estimation import Fit, natural
from scilab_rl.analysis.fitting.panel import Panel
from scilab_rl.errors import MissingDependencyError
from scilab_rl.learning.cognitive import CognitiveModel, Seen, log_likelihoods

MOST_R_HAT, LEAST_EFFECTIVE = 1.01, 400.0
# What NumPyro says of each draw, and how ArviZ calls it.
_STATISTICS = {
    "diverging": "diverging",
    "num_steps": "n_steps",
    "accept_prob": "acceptance_rate",
    "energy": "energy",
}


@dataclass(frozen=True)
class Posterior:
    """Samples of a hierarchical model.

    Attributes:
        name: The model's name.
        model: The model.
        panel: The choices.
        group: Group means, on the real scale.
        spread: Standard deviations between participants, on the real scale.
        participants: Parameters of each, on the real scale.
        statistics: Of the sampler, by ArviZ's names.
        r_hat: The largest of each kind of quantity.
        effective: The smallest effective sample size of each kind.

    Shapes:
        group, spread: ``(n_chains, n_draws, n_parameters)``; participants: ``(n_chains, n_draws,
        n_participants, n_parameters)``; statistics: ``(n_chains, n_draws)``.
    """

    name: str
    model: type[CognitiveModel]
    panel: Panel
    group: np.ndarray
    spread: np.ndarray
    participants: np.ndarray
    statistics: Mapping[str, np.ndarray]
    r_hat: Mapping[str, float]
    effective: Mapping[str, float]

    @property
    def n_divergent(self) -> int:
        """Divergent transitions after the warm-up."""
        return int(self.statistics["diverging"].sum())

    @property
    def problem(self) -> str:
        """Why nothing may be concluded; empty if the chains agree."""
        # NumPy's, because a NaN must not be hidden.
        largest = float(np.max([*self.r_hat.values()]))
        smallest = float(np.min([*self.effective.values()]))
        found = []
        if not largest <= MOST_R_HAT:
            found.append(f"R-hat is {largest:.3f}, above {MOST_R_HAT}")
        if not smallest >= LEAST_EFFECTIVE:
            found.append(f"an effective sample size is {smallest:.0f}, below {LEAST_EFFECTIVE:.0f}")
        if self.n_divergent:
            found.append(f"{self.n_divergent} transitions diverged")
        return "; ".join(found)

    def group_rows(self) -> list[dict[str, object]]:
        """Return the group means on the parameters' own scales, with 95 % intervals."""
        values = natural(self.model, self.group)
        return [
            {
                "model": self.name,
                "parameter": name,
                "group mean": float(np.median(draws)),
                "low": float(np.quantile(draws, 0.025)),
                "high": float(np.quantile(draws, 0.975)),
            }
            for name, draws in values.items()
        ]


def sample_posterior(
    fitted: Fit,
    *,
    n_warmup: int = 500,
    n_samples: int = 1000,
    n_chains: int = 4,
    seed: int = 0,
) -> Posterior:
    """Sample the hierarchical model of all participants.

    Args:
        fitted: Estimates of single participants, at which the chains begin.
        n_warmup: Steps per chain that tune the sampler.
        n_samples: Steps per chain that are kept.
        n_chains: Chains, which are sampled side by side.
        seed: Of the sampler.

    Raises:
        MissingDependencyError: If NumPyro is not installed.
    """
    try:
        import numpyro
        from numpyro import distributions as dist
        from numpyro.diagnostics import summary
        from numpyro.infer import MCMC, NUTS, init_to_value
    except ImportError as error:
        raise MissingDependencyError("numpyro", "cognition", "for hierarchical=true") from error

    mean, sd = (
        jnp.array([getattr(p, name) for p in fitted.model.parameters.values()])
        for name in ("mean", "sd")
    )
    spreads = jnp.array(
        [p.sd if p.spread_sd is None else p.spread_sd for p in fitted.model.parameters.values()]
    )
    shape, choices = fitted.real.shape, _log_likelihood(fitted)

    def population() -> None:
        mu = numpyro.sample("group", dist.Normal(mean, sd).to_event(1))
        sigma = numpyro.sample("spread", dist.HalfNormal(spreads).to_event(1))
        z = numpyro.sample("z", dist.Normal(0.0, 1.0).expand(shape).to_event(2))
        numpyro.factor("choices", choices(numpyro.deterministic("participants", mu + sigma * z)))

    sampler = MCMC(
        NUTS(population, init_strategy=init_to_value(values=_start(fitted))),
        num_warmup=n_warmup,
        num_samples=n_samples,
        num_chains=n_chains,
        chain_method="vectorized",
        progress_bar=False,
    )
    sampler.run(jax.random.key(seed), extra_fields=tuple(_STATISTICS))
    chains = sampler.get_samples(group_by_chain=True)
    chains = {name: np.asarray(chains[name]) for name in ("group", "spread", "participants")}
    quality = summary(chains)
    said = sampler.get_extra_fields(group_by_chain=True)
    return Posterior(
        name=fitted.name,
        model=fitted.model,
        panel=fitted.panel,
        **chains,
        statistics={new: np.asarray(said[old]) for old, new in _STATISTICS.items()},
        r_hat={name: float(np.max(quality[name]["r_hat"])) for name in chains},
        effective={name: float(np.min(quality[name]["n_eff"])) for name in chains},
    )


def _start(fitted: Fit) -> dict[str, Any]:
    mu, sigma = fitted.real.mean(axis=0), np.maximum(fitted.real.std(axis=0), 0.1)
    return {"group": mu, "spread": sigma, "z": (fitted.real - mu) / sigma}


def _log_likelihood(fitted: Fit) -> Any:
    """Return a function of all participants' parameters: the log-probability of all choices."""
    panel, parameters = fitted.panel, fitted.model.parameters

    def one(x: Any, seen: Seen, responses: Any, counts: Any) -> Any:
        values = {name: p.from_real(x[k]) for k, (name, p) in enumerate(parameters.items())}
        each = log_likelihoods(
            fitted.model, panel.n_states, panel.n_actions, values, seen, responses
        )
        return (each * counts).sum()

    data = jax.tree.map(jnp.asarray, (panel.seen, panel.responses, panel.counts))
    return lambda x: jax.vmap(one)(x, *data).sum()
