"""The two-step task, which tells planning from habit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scilab_rl.drawing import COLORS, FAINT, INK, font
from scilab_rl.envs.choices.base import WIDTH, ChoiceTask, draw_cards, random_walk

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

FIRST = 0  # the state of the first choice; the others are 1 and 2


class TwoStep(ChoiceTask):
    """Choose a spaceship, arrive on one of two planets, and choose an alien who may pay.

    The task of Daw et al. (2011), Neuron 69. The first choice (state 0) leads to the planet of the
    same side (response 0 to state 1, response 1 to state 2) with ``p_common``, else to the other.
    There the second choice pays 1 with a probability that drifts on its own for each of the four
    aliens: a Gaussian random walk with sd ``drift``, reflected at 0.25 and 0.75. A planner repeats
    a first choice that was paid after a common transition and changes it after a rare one; habit
    repeats both.

    Each trial has two steps, ``stage`` 0 and 1; the columns ``common`` (1 or 0) and ``correct``
    belong to both.

    Args:
        n_trials: Trials of a block, of two choices each.
        p_common: Probability of the common transition.
        drift: Standard deviation of the walks' steps.
        render_mode: ``rgb_array``, or None for no frames.
    """

    title = "Two-step"

    def __init__(
        self,
        n_trials: int = 200,
        p_common: float = 0.7,
        drift: float = 0.025,
        render_mode: str | None = None,
    ) -> None:
        self.p_common, self.drift = p_common, drift
        super().__init__(
            ("left", "right"), n_states=3, n_stages=2, n_trials=n_trials, render_mode=render_mode
        )

    def draw_block(self) -> None:
        """Draw transitions, the walks of the four probabilities, and what each would pay."""
        self.is_common = self.np_random.random(self.n_trials) < self.p_common
        shape = (self.n_trials, 2, 2)
        self.means = random_walk(self.np_random, shape, sd=self.drift, low=0.25, high=0.75)
        self.outcomes = self.np_random.random(shape) < self.means

    def respond(self, response: int) -> dict[str, float]:
        """Travel to a planet, or be paid there."""
        common, means = bool(self.is_common[self.row]), self.means[self.row]
        if self.state == FIRST:
            self.state = 1 + (response if common else 1 - response)
            best = means.max(axis=1)
            value = self.p_common * best + (1 - self.p_common) * best[::-1]
            return {"common": int(common), "correct": int(value[response] >= value.max())}
        planet = self.state - 1
        self.state = FIRST
        columns = {
            "stage": 1,
            "feedback": float(self.outcomes[self.row, planet, response]),
            "common": int(common),
            "correct": int(means[planet, response] >= means[planet].max()),
        }
        self.trial += 1
        return columns

    def draw(self, pen: ImageDraw) -> None:
        """Draw the spaceships, or the planet's aliens in its color."""
        at_first = self.state == FIRST
        colors = COLORS[:2] if at_first else (COLORS[self.state + 1],)
        place = "Choose a spaceship" if at_first else f"Planet {self.state}: choose an alien"
        pen.text((24, 46), place, FAINT, font(16))
        if at_first and self.last is not None:
            text = f"The last trial was {'paid' if self.last['feedback'] else 'not paid'}"
            pen.text((WIDTH / 2, 104), text, INK, font(18), anchor="mm")
        draw_cards(pen, self.action_names, None, colors=colors, prompt=False)
