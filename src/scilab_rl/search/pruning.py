"""Stopping weak runs early, by Optuna's pruners.

A run is compared with the runs of other configurations *with the same seed*, epoch by epoch, so
that a lucky seed does not prune an unlucky one. Optuna's own trials are whole configurations here,
so the comparison lives in studies in memory, one for each repeat, rebuilt on a resume.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING

from scilab_rl.search.runs import COMPLETE, Run

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
    """Tells which running runs are weak.

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
            if run.state == COMPLETE and run.identity not in self._finished and run.values:
                self._finished.add(run.identity)
                self._finish(run)

    def is_weak(self, run: Run, epoch: int, value: float) -> bool:
        """Hear of an evaluation of a run and return whether the run must stop.

        Args:
            run: The run.
            epoch: Number of the evaluation, from 1.
            value: The criterion.
        """
        if run.identity not in self._trials:
            self._trials[run.identity] = self._study(run).ask()
        trial = self._trials[run.identity]
        with warnings.catch_warnings():
            # Each value of a run that was watched live comes again when the run has finished.
            warnings.simplefilter("ignore", UserWarning)
            trial.report(value, epoch)
        return trial.should_prune()

    def _finish(self, run: Run) -> None:
        import optuna

        by_rungs = isinstance(self.pruner, optuna.pruners.HyperbandPruner)  # it marks what it saw
        if by_rungs or run.identity in self._trials:
            for epoch, value in enumerate(run.values, start=1):
                self.is_weak(run, epoch, value)
            self._study(run).tell(self._trials[run.identity], run.values[-1])
        elif not math.isnan(run.values[-1]):
            curve = dict(enumerate(run.values, start=1))
            self._study(run).add_trial(
                optuna.trial.create_trial(value=run.values[-1], intermediate_values=curve)
            )

    def _study(self, run: Run) -> optuna.Study:
        import optuna

        if run.repeat not in self._studies:
            self._studies[run.repeat] = optuna.create_study(
                direction="maximize" if self.maximize else "minimize",
                pruner=self.pruner,
                study_name=f"repeat-{run.repeat}",  # Hyperband draws its brackets from it
            )
        return self._studies[run.repeat]
