"""Optuna's samplers by name, seeded so that a resumed study goes on as it would have."""

from __future__ import annotations

import importlib.util
import warnings
from typing import TYPE_CHECKING

from scilab_rl.errors import MissingDependencyError
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:
    import optuna

# sampler -> the packages it needs beside Optuna
SAMPLERS: dict[str, tuple[str, ...]] = {
    "tpe": (), "random": (), "cmaes": ("cmaes",), "nsgaii": (), "gp": ("scipy", "torch"),
    "qmc": ("scipy",), "grid": (),
}  # fmt: skip


def require_packages(sampler: str) -> None:
    """Refuse a sampler whose packages are not installed.

    Raises:
        MissingDependencyError: With the command that installs them.
    """
    for package in SAMPLERS[sampler]:
        if importlib.util.find_spec(package) is None:
            raise MissingDependencyError(package, "hyperopt", f"for the sampler {sampler}")


def make_sampler(name: str, seed: int, trial_number: int) -> optuna.samplers.BaseSampler:
    """Return the sampler for one trial.

    Its seed depends on the trial's number, so that a study that was killed and resumed draws what
    the uninterrupted one would have drawn. Low-discrepancy sequences keep one seed, because they
    count their points in the storage.

    Args:
        name: A key of `SAMPLERS`; the settings of ``grid`` are listed elsewhere.
        seed: Seed of the study.
        trial_number: Number of the trial that the sampler is for.
    """
    import optuna

    trial_seed = derive_seed(seed, "sampler", trial_number)
    samplers = optuna.samplers
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if name == "tpe":
            return samplers.TPESampler(seed=trial_seed)
        if name == "cmaes":
            return samplers.CmaEsSampler(seed=trial_seed, warn_independent_sampling=False)
        if name == "nsgaii":
            return samplers.NSGAIISampler(seed=trial_seed)
        if name == "gp":
            return samplers.GPSampler(seed=trial_seed, warn_independent_sampling=False)
        if name == "qmc":
            return samplers.QMCSampler(
                seed=seed,
                scramble=True,
                independent_sampler=samplers.RandomSampler(trial_seed),
                warn_independent_sampling=False,
            )
        return samplers.RandomSampler(trial_seed)
