"""Where new settings come from: the sampler, or the list of all settings of a small space."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable

import optuna
from optuna.trial import FrozenTrial, TrialState

from scilab_rl.hyperopt.ledger import Ledger
from scilab_rl.hyperopt.race import RaceRules
from scilab_rl.hyperopt.samplers import make_sampler
from scilab_rl.hyperopt.space import SearchSpace, Setting
from scilab_rl.seeding import derive_seed

_MOST_LISTED = 10_000
_MOST_DUPLICATES = 20


class SettingsSource:
    """Gives each setting at most once.

    The setting that the configuration has already comes first, so that what one has is always part
    of the comparison. A space with no more settings than the budget can try is then tried
    completely, in an order drawn by the study's seed. Otherwise the sampler is asked; settings that
    it proposes again are told as failed, because further repeats are the race's decision.

    Args:
        ledger: The memory of the study; its lock must be held during each call.
        space: The search space.
        sampler: Name of the sampler; ``grid`` tries the whole space in its order.
        seed: Seed of the study.
        rules: What may be spent.
        present: The setting that the configuration has, if the space holds it; not for ``grid``.

    Attributes:
        is_exhaustive: Whether all settings of the space will be tried.
    """

    def __init__(
        self,
        ledger: Ledger,
        space: SearchSpace,
        sampler: str,
        seed: int,
        rules: RaceRules,
        present: Setting | None = None,
    ) -> None:
        self.ledger = ledger
        self.present = None if sampler == "grid" else present
        self.space = space
        self.sampler = sampler
        self.seed = seed
        self.asked: dict[int, optuna.Trial] = {}
        self._listed: list[Setting] = []
        if sampler == "grid" or space.size() <= _MOST_LISTED:
            self._listed = list(space.all_settings())
            if sampler != "grid":
                random.Random(seed).shuffle(self._listed)
        self.is_exhaustive = bool(self._listed) and (
            sampler == "grid" or len(self._listed) * rules.min_runs <= rules.budget
        )

    def n_left(self) -> float:
        """Return how many settings have not been tried."""
        return len(self._untried()) if self._listed else math.inf

    def ask(self, n_settings: int) -> int | None:
        """Return the number of a new trial with a setting of its own, or None when none is left.

        Args:
            n_settings: How many settings there are. It makes the draw reproducible, whatever a
                crash has left among the trials.
        """
        if n_settings == 0 and self.present is not None:
            return self._ask_for(self.present, n_settings)
        for attempt in range(0 if self.is_exhaustive else _MOST_DUPLICATES):
            earlier = settings_of(self.ledger.trials())
            number, setting = self._ask(n_settings, attempt)
            if setting not in earlier.values():
                return number
            self.ledger.tell(number, state=TrialState.FAIL)
        untried = self._untried()
        if not untried:
            return None
        return self._ask_for(untried[0], n_settings)

    def discard_torn(self) -> None:
        """Give up trials whose process was killed while it was asking the sampler."""
        for trial in self.ledger.trials(TrialState.RUNNING):
            if len(trial.params) < len(self._expected(trial.params)):
                self.ledger.tell(trial.number, state=TrialState.FAIL)

    def _ask_for(self, setting: Setting, n_settings: int) -> int:
        if not self.ledger.trials(TrialState.WAITING):  # else a killed process has done so
            self.ledger.study.enqueue_trial(setting)
            self.ledger.refresh()
        return self._ask(n_settings, _MOST_DUPLICATES)[0]

    def _ask(self, n_settings: int, attempt: int) -> tuple[int, Setting]:
        study = self.ledger.study
        draw_seed = derive_seed(self.seed, "sampler", n_settings, attempt)
        study.sampler = make_sampler(self.sampler, self.seed, draw_seed)
        trial = study.ask()
        self.asked[trial.number] = trial
        setting = self.space.suggest(trial)
        self.ledger.refresh()
        return trial.number, setting

    def _untried(self) -> list[Setting]:
        tried = settings_of(self.ledger.trials()).values()
        return [setting for setting in self._listed if setting not in tried]

    def _expected(self, setting: Setting) -> list[str]:
        return [p.name for p in self.space.parameters if p.exists_in(setting)]


def settings_of(trials: Iterable[FrozenTrial]) -> dict[int, Setting]:
    """Return the settings of all trials that are more than a refused or torn question."""
    return {
        trial.number: dict(trial.params)
        for trial in trials
        if trial.params and trial.state not in (TrialState.WAITING,)
    }
