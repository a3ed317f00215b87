"""Stopping hopeless runs early, by Optuna's pruners.

A run is compared with the runs of other settings *with the same seed*, epoch by epoch, so that a
lucky seed does not prune an unlucky one. Optuna's own trials hold whole settings here, so the
comparison lives in studies in memory, one for each repeat, rebuilt from the ledger on a resume.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING

from scilab_rl.hyperopt.runs import COMPLETE, Run

if TYPE_CHECKING:
    import optuna

PRUNERS = ("median", "percentile", "hyperband", "none")
_PERCENTILE = 25.0  # of the peers, those above are pruned
_STARTUP_RUNS = 5  # finished runs with the same seed before anything is pruned


def make_pruner(name: str, warmup_epochs: int, n_epochs: int) -> optuna.pruners.BasePruner:
    """Return a pruner that looks at one value per epoch, counted from 1.

    Args:
        name: One of `PRUNERS`.
        warmup_epochs: Epochs in which no run is pruned.
        n_epochs: Epochs of a whole run.
    """
    import optuna

    first = warmup_epochs + 1
    if name == "median":
        return optuna.pruners.MedianPruner(_STARTUP_RUNS, first)
    if name == "percentile":
        return optuna.pruners.PercentilePruner(_PERCENTILE, _STARTUP_RUNS, first)
    if name == "hyperband":
        return optuna.pruners.HyperbandPruner(first, max(n_epochs, first))
    return optuna.pruners.NopPruner()


class Pruning:
    """Tells which running runs are hopeless.

    Args:
        name: The pruner.
        warmup_epochs: Epochs in which no run is pruned; None means a third of them.
        n_epochs: Epochs of a whole run.
        maximize: Whether larger evaluations are better.
    """

    def __init__(
        self, name: str, warmup_epochs: int | None, n_epochs: int, *, maximize: bool
    ) -> None:
        warmup = n_epochs // 3 if warmup_epochs is None else warmup_epochs
        self.pruner = make_pruner(name, warmup, n_epochs)
        self.maximize = maximize
        self._studies: dict[int, optuna.Study] = {}
        self._trials: dict[tuple[int, int], optuna.Trial] = {}
        self._finished: set[tuple[int, int]] = set()

    def learn_from(self, runs: Iterable[Run]) -> None:
        """Take in the finished runs, also those of other processes and of earlier sessions."""
        for run in runs:
            if run.state != COMPLETE or run.identity in self._finished or not run.values:
                continue
            for epoch, value in enumerate(run.values, start=1):
                self.is_hopeless(run, epoch, value)
            self._studies[run.repeat].tell(self._trials[run.identity], run.values[-1])
            self._finished.add(run.identity)

    def is_hopeless(self, run: Run, epoch: int, value: float) -> bool:
        """Hear of an evaluation of a run and tell whether the run shall stop.

        Args:
            run: The run.
            epoch: Number of the evaluation, from 1.
            value: The criterion.
        """
        trial = self._trials.get(run.identity) or self._begin(run)
        with warnings.catch_warnings():
            # Each value of a run that was watched live comes again when the run has finished.
            warnings.simplefilter("ignore", UserWarning)
            trial.report(value, epoch)
        return trial.should_prune()

    def _begin(self, run: Run) -> optuna.Trial:
        import optuna

        if run.repeat not in self._studies:
            self._studies[run.repeat] = optuna.create_study(
                direction="maximize" if self.maximize else "minimize",
                pruner=self.pruner,
                study_name=f"repeat-{run.repeat}",  # Hyperband draws its brackets from it
            )
        return self._trials.setdefault(run.identity, self._studies[run.repeat].ask())
