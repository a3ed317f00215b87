"""Hierarchical samples for ArviZ: the file that its plots and others read, and its PSIS-LOO.

LOO is the log-probability of a choice given the parameters that all other choices determine, and
the trials before it (Vehtari, Gelman & Gabry, 2017, Statistics and Computing 27). Its estimate is
unreliable where the Pareto k of a choice is large.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from scilab_rl.analysis.fitting.estimation import natural
from scilab_rl.analysis.fitting.hierarchical import Posterior
from scilab_rl.errors import MissingDependencyError
from scilab_rl.learning.cognitive import Seen, log_likelihoods

_MOST_DRAWS = 1000  # with log-likelihoods: a number for each choice and draw


@dataclass(frozen=True)
class LeaveOneOut:
    """How well choices are predicted by all others.

    Attributes:
        elpd: Sum of the expected log-probabilities of the choices.
        error: Its standard error.
        n_choices: How many there are.
        n_bad: Those whose Pareto k is too large.
    """

    elpd: float
    error: float
    n_choices: int
    n_bad: int


def import_arviz() -> Any:
    """Return ArviZ.

    Raises:
        MissingDependencyError: If it is not installed.
    """
    try:
        with warnings.catch_warnings():
            # Once a day, the import announces ArviZ 1.0, whose interface differs.
            warnings.simplefilter("ignore", FutureWarning)
            import arviz
    except ImportError as error:
        raise MissingDependencyError("arviz", "cognition", "for hierarchical=true") from error
    return arviz


def make_inference_data(posterior: Posterior) -> Any:
    """Return samples as ArviZ's InferenceData.

    Its groups are ``posterior`` (each parameter of participants and group on its own scale, and the
    spread between participants on the real scale), ``sample_stats``, ``log_likelihood``,
    ``observed_data``, and ``constant_data``: whose choice is which. Log-likelihoods are thinned to
    at most 1,000 draws.
    """
    arviz, panel = import_arviz(), posterior.panel
    step = -(-posterior.group[..., 0].size // _MOST_DRAWS)
    people, trials = np.nonzero(panel.counts)
    spread = {
        f"{name}_spread": posterior.spread[..., k]
        for k, name in enumerate(posterior.model.parameters)
    }
    group = natural(posterior.model, posterior.group)
    data = arviz.from_dict(
        posterior=natural(posterior.model, posterior.participants)
        | {f"{name}_group": draws for name, draws in group.items()}
        | spread,
        sample_stats=dict(posterior.statistics),
        observed_data={"response": panel.responses[people, trials]},
        constant_data={"participant_index": people, "choice_index": trials},
        coords={"participant": list(panel.participants)},
        dims={name: ["participant"] for name in posterior.model.parameters}
        | {name: ["choice"] for name in ("response", "participant_index", "choice_index")},
        attrs={"model": posterior.name},
    )
    data.add_groups(
        log_likelihood={"response": _log_likelihood(posterior, step)[..., people, trials]},
        coords={"draw": np.arange(0, posterior.group.shape[1], step)},
        dims={"response": ["choice"]},
    )
    return data


def leave_one_out(posterior: Posterior, data: Any) -> LeaveOneOut:
    """Return PSIS-LOO by ArviZ.

    Args:
        posterior: The samples.
        data: The same, from `make_inference_data`.
    """
    each = data.log_likelihood["response"]
    n_draws = each[..., 0].size
    # Of equal weights, as those of a first choice are, the estimate is exact, but k is infinite.
    varies = np.ptp(each.values, axis=(0, 1)) > 1e-6
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of bad k, which are counted here
        found = import_arviz().loo(
            data, pointwise=True, reff=min(1.0, min(posterior.effective.values()) / n_draws)
        )
    return LeaveOneOut(
        elpd=float(found.elpd_loo),
        error=float(found.se),
        n_choices=int(found.n_data_points),
        n_bad=int(((found.pareto_k.values > found.good_k) & varies).sum()),
    )


def write_inference_data(data: Any, path: Path) -> None:
    """Write a NetCDF file, which ``arviz.from_netcdf`` opens."""
    path.unlink(missing_ok=True)  # HDF5 locks a file that is being overwritten
    data.to_netcdf(str(path), engine="h5netcdf")


def _log_likelihood(posterior: Posterior, step: int) -> np.ndarray:
    """Return the log-probability of each choice for every so many draws of each chain.

    Shapes:
        result: ``(n_chains, n_draws, n_participants, n_choices)``.
    """
    model, panel = posterior.model, posterior.panel

    def one(values: Any, seen: Seen, responses: Any) -> Any:
        return log_likelihoods(model, panel.n_states, panel.n_actions, values, seen, responses)

    of_all = jax.vmap(one)
    draws = natural(model, posterior.participants[:, ::step])
    flat = {name: table.reshape(-1, table.shape[-1]) for name, table in draws.items()}
    found = jax.jit(jax.vmap(of_all, (0, None, None)))(flat, panel.seen, panel.responses)
    return np.asarray(found).reshape(*posterior.participants[:, ::step].shape[:2], *found.shape[1:])
