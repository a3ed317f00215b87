"""Where new configurations come from: the sampler, or the list of all of a small space."""

from __future__ import annotations

import math
import random

import optuna
from optuna.trial import TrialState

from scilab_rl.search.race import RaceRules
from scilab_rl.search.samplers import make_sampler
from scilab_rl.search.space import SearchSpace, Setting
from scilab_rl.search.storage import StudyStorage
from scilab_rl.seeding import derive_seed

_MOST_LISTED = 10_000
_MOST_DUPLICATES = 20


class ConfigurationSource:
    """Gives each configuration at most once.

    The baseline comes first, so that what one has is always part of the comparison. A space with no
    more configurations than the budget can try is then tried completely, in an order drawn by the
    study's seed. Otherwise the sampler is asked; what it proposes again is reported as failed,
    because further repeats are the race's decision.

    Args:
        storage: The memory of the study; its lock must be held during each call.
        space: The search space.
        sampler: Name of the sampler; ``grid`` tries the whole space in its order.
        seed: Seed of the study.
        rules: What may be spent.
        baseline: The searched values as they would be without a search, if the space holds them;
            not for ``grid``.

    Attributes:
        is_exhaustive: Whether all configurations of the space will be tried.
    """

    def __init__(
        self,
        storage: StudyStorage,
        space: SearchSpace,
        sampler: str,
        seed: int,
        rules: RaceRules,
        baseline: Setting | None = None,
    ) -> None:
        self.storage = storage
        self.baseline = None if sampler == "grid" else baseline
        self.space = space
        self.sampler = sampler
        self.seed = seed
        self.suggested: dict[int, optuna.Trial] = {}
        self._identities: dict[int, object] = {}  # by trial
        self._size = space.size()
        self._shuffled: list[Setting] = []
        if sampler == "grid":
            space.refuse_continuum()
        elif self._size <= _MOST_LISTED:
            self._shuffled = list(space.all_settings())
            random.Random(seed).shuffle(self._shuffled)
        is_affordable = bool(self._shuffled) and self._size * rules.min_runs <= rules.budget
        self.is_exhaustive = sampler == "grid" or is_affordable

    def n_left(self) -> float:
        """Return how many configurations have not been tried."""
        is_known = self._shuffled or self.sampler == "grid"
        return self._size - len(self._tried()) if is_known else math.inf

    def suggest(self, n_configurations: int) -> int | None:
        """Return the number of a new trial, or None when no configuration is left.

        Args:
            n_configurations: How many there are. It makes the draw reproducible, whatever a crash
                has left among the trials.
        """
        if n_configurations == 0 and self.baseline is not None:
            return self._suggest_given(self.baseline, n_configurations)
        for attempt in range(0 if self.is_exhaustive else _MOST_DUPLICATES):
            earlier = self._tried()
            number, configuration = self._suggest(n_configurations, attempt)
            if self.space.identity(configuration) not in earlier:
                return number
            self.storage.tell(number, state=TrialState.FAIL)
        untried = self._next_untried()
        return None if untried is None else self._suggest_given(untried, n_configurations)

    def discard_torn(self) -> None:
        """Give up trials whose process was killed while it was asking the sampler."""
        for trial in self.storage.trials(TrialState.RUNNING):
            if len(trial.params) < len(self._expected(trial.params)):
                self.storage.tell(trial.number, state=TrialState.FAIL)

    def _suggest_given(self, configuration: Setting, n_configurations: int) -> int:
        if not self.storage.trials(TrialState.WAITING):  # else a killed process has done so
            self.storage.study.enqueue_trial(configuration)
            self.storage.refresh()
        return self._suggest(n_configurations, _MOST_DUPLICATES)[0]

    def _suggest(self, n_configurations: int, attempt: int) -> tuple[int, Setting]:
        study = self.storage.study
        draw_seed = derive_seed(self.seed, "sampler", n_configurations, attempt)
        study.sampler = make_sampler(self.sampler, self.seed, draw_seed)
        trial = study.ask()
        self.suggested[trial.number] = trial
        configuration = self.space.suggest(trial)
        self.storage.refresh()
        return trial.number, configuration

    def _next_untried(self) -> Setting | None:
        in_order = self.space.all_settings() if self.sampler == "grid" else self._shuffled
        tried = self._tried()
        return next((s for s in in_order if self.space.identity(s) not in tried), None)

    def _tried(self) -> set[object]:
        """Return the identities of the configurations of this space that have been tried."""
        configurations = self.storage.configurations()
        for number in configurations.keys() - self._identities.keys():
            self._identities[number] = self.space.identity(configurations[number])
        return {self._identities[number] for number in configurations} - {None}

    def _expected(self, configuration: Setting) -> list[str]:
        return [p.name for p in self.space.parameters if p.exists_in(configuration)]
