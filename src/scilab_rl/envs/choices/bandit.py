"""Bandits: one state, some arms, and feedback after each choice."""

from __future__ import annotations

import numpy as np

from scilab_rl.envs.choices.base import ChoiceTask, random_walk
from scilab_rl.envs.goal import require_choice
from scilab_rl.errors import ConfigError

SCHEDULES = ("static", "reversal", "drifting")
FEEDBACKS = ("binary", "points")


class Bandit(ChoiceTask):
    """Choose among arms whose rewards are static, reverse or drift.

    Binary feedback is 1 with the probability of the arm and else 0. *Static* probabilities are
    evenly spaced between ``p_worst`` and ``p_best`` and shuffled at each reset; with *reversal*
    their order is turned round every ``reversal_every`` trials; *drifting* ones are Gaussian random
    walks (sd 0.025, reflected at 0.25 and 0.75) as in Daw et al. (2011), Neuron 69.

    Points are those of Daw et al. (2006), Nature 441, divided by 100: Gaussian with sd 4 around the
    mean of the arm. Drifting means follow their walk, which decays to 50 by 0.9836 per trial with
    steps of sd 2.8; the others are 100 times the probabilities above.

    Args:
        n_arms: From 2 to 10.
        schedule: static, reversal or drifting.
        feedback: binary or points.
        n_trials: Trials of a block.
        p_best: Of the best arm.
        p_worst: Of the worst arm.
        reversal_every: Trials between reversals.
        render_mode: ``rgb_array``, or None for no frames.
    """

    title = "Bandit"

    def __init__(
        self,
        n_arms: int = 2,
        schedule: str = "static",
        feedback: str = "binary",
        n_trials: int = 200,
        p_best: float = 0.8,
        p_worst: float = 0.2,
        reversal_every: int = 40,
        render_mode: str | None = None,
    ) -> None:
        require_choice("schedule", schedule, SCHEDULES)
        require_choice("feedback", feedback, FEEDBACKS)
        if not 2 <= n_arms <= 10:
            raise ConfigError(f"env_kwargs.n_arms must be from 2 to 10, but it is {n_arms}.")
        if not 0.0 <= p_worst <= p_best <= 1.0:
            raise ConfigError(
                f"env_kwargs: 0 <= p_worst <= p_best <= 1, but they are {p_worst:g} and {p_best:g}."
            )
        super().__init__(arm_names(n_arms), n_trials=n_trials, render_mode=render_mode)
        self.schedule, self.feedback = schedule, feedback
        self.p_best, self.p_worst = p_best, p_worst
        self.reversal_every = reversal_every

    def draw_block(self) -> None:
        """Draw what each arm pays on average, and what it would pay, in each trial."""
        shape = (self.n_trials, len(self.action_names))
        self.means = self._draw_means(shape)
        if self.feedback == "binary":
            self.outcomes = (self.np_random.random(shape) < self.means).astype(float)
        else:
            self.outcomes = np.clip(self.np_random.normal(self.means, 0.04), 0.0, 1.0)

    def _draw_means(self, shape: tuple[int, int]) -> np.ndarray:
        if self.schedule == "drifting":
            if self.feedback == "points":
                return _decaying_walk(self.np_random, shape)
            return random_walk(self.np_random, shape, sd=0.025, low=0.25, high=0.75)
        order = self.np_random.permutation(shape[1])
        levels = np.linspace(self.p_worst, self.p_best, shape[1])
        is_reversed = np.zeros(shape[0], bool)
        if self.schedule == "reversal":
            is_reversed = np.arange(shape[0]) // self.reversal_every % 2 == 1
        return np.where(is_reversed[:, None], levels[::-1][order], levels[order])

    def respond(self, response: int) -> dict[str, float]:
        """Pay what was drawn for this arm in this trial."""
        means = self.means[self.row]
        columns = {"feedback": float(self.outcomes[self.row, response])}
        columns["correct"] = int(means[response] >= means.max())
        columns |= {f"mean_{arm}": float(mean) for arm, mean in enumerate(means)}
        if self.schedule == "reversal":
            columns["reversals"] = self.row // self.reversal_every
        self.trial += 1
        return columns


class ProbabilisticReversal(ChoiceTask):
    """Two stimuli; the better one becomes the worse one as soon as it has been learned.

    After ``criterion`` correct choices in a row, each trial reverses with ``p_reversal``, as
    in Hampton et al. (2006), J Neurosci 26, so that a reversal depends on what was learned.

    Args:
        n_trials: Trials of a block.
        p_correct: Probability that the better stimulus pays 1.
        p_incorrect: The same for the worse one.
        criterion: Correct choices in a row before a reversal.
        p_reversal: Probability of a reversal in each trial after that.
        render_mode: ``rgb_array``, or None for no frames.
    """

    title = "Probabilistic reversal"

    def __init__(
        self,
        n_trials: int = 200,
        p_correct: float = 0.8,
        p_incorrect: float = 0.2,
        criterion: int = 4,
        p_reversal: float = 0.25,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(arm_names(2), n_trials=n_trials, render_mode=render_mode)
        self.p_correct, self.p_incorrect = p_correct, p_incorrect
        self.criterion, self.p_reversal = criterion, p_reversal

    def draw_block(self) -> None:
        """Draw the first better stimulus, and the chances of payments and reversals."""
        self.better = int(self.np_random.integers(2))
        self.n_reversals = self._in_a_row = 0
        self._payment_chances = self.np_random.random((self.n_trials, 2))
        self._reversal_chances = self.np_random.random(self.n_trials)

    def respond(self, response: int) -> dict[str, float]:
        """Pay, and reverse when it is time."""
        correct = response == self.better
        p = self.p_correct if correct else self.p_incorrect
        paid = self._payment_chances[self.row, response] < p
        columns = {
            "feedback": float(paid),
            "correct": int(correct),
            "reversals": self.n_reversals,
        }
        self._in_a_row = self._in_a_row + 1 if correct else 0
        learned = self._in_a_row >= self.criterion
        if learned and self._reversal_chances[self.row] < self.p_reversal:
            self.better = 1 - self.better
            self.n_reversals += 1
            self._in_a_row = 0
        self.trial += 1
        return columns


def arm_names(n_arms: int) -> tuple[str, ...]:
    """Return names of arms.

    >>> arm_names(2), arm_names(3)
    (('left', 'right'), ('A', 'B', 'C'))
    """
    return ("left", "right") if n_arms == 2 else tuple("ABCDEFGHIJ"[:n_arms])


def _decaying_walk(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    means = np.empty(shape)
    means[0] = rng.uniform(0.25, 0.75, shape[1:])
    steps = rng.normal(0.0, 0.028, shape)
    for trial in range(1, shape[0]):
        means[trial] = 0.9836 * means[trial - 1] + (1 - 0.9836) * 0.5 + steps[trial]
    return np.clip(means, 0.0, 1.0)
