"""Optuna's samplers by name, seeded so that a resumed study continues as it would have."""

from __future__ import annotations

import importlib.util
import warnings
from typing import TYPE_CHECKING

from scilab_rl.errors import MissingDependencyError

if TYPE_CHECKING:
    import optuna

# sampler -> the packages it needs in addition to Optuna
SAMPLERS: dict[str, tuple[str, ...]] = {
    "tpe": (), "random": (), "cmaes": ("cmaes",), "nsgaii": (), "gp": (),
    "qmc": (), "grid": (),
}  # fmt: skip


def require_packages(sampler: str) -> None:
    """Reject a sampler whose packages are not installed.

    Raises:
        MissingDependencyError: With the command that installs them.
    """
    for package in SAMPLERS[sampler]:
        if importlib.util.find_spec(package) is None:
            raise MissingDependencyError(package, "hyperopt", f"for the sampler {sampler}")


def make_sampler(name: str, study_seed: int, draw_seed: int) -> optuna.samplers.BaseSampler:
    """Return the sampler for one draw.

    Each draw has a seed of its own, so that a study that was killed and resumed draws what the
    uninterrupted one would have drawn. Low-discrepancy sequences keep the study's seed, because
    they count their points in the storage.

    Args:
        name: A key of `SAMPLERS`; the configurations of ``grid`` are listed elsewhere.
        study_seed: Seed of the study.
        draw_seed: Seed of this draw.
    """
    import optuna

    samplers = optuna.samplers
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if name == "tpe":
            return samplers.TPESampler(seed=draw_seed)
        if name == "cmaes":
            return samplers.CmaEsSampler(seed=draw_seed, warn_independent_sampling=False)
        if name == "nsgaii":
            return samplers.NSGAIISampler(seed=draw_seed)
        if name == "gp":
            return samplers.GPSampler(seed=draw_seed, warn_independent_sampling=False)
        if name == "qmc":
            return samplers.QMCSampler(
                seed=study_seed,
                scramble=True,
                independent_sampler=samplers.RandomSampler(draw_seed),
                warn_independent_sampling=False,
            )
        return samplers.RandomSampler(draw_seed)
