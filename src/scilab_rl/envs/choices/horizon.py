"""The horizon task, which tells curiosity from chance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.drawing import BACKGROUND, COLORS, FAINT, FRAME, GRID, INK, font
from scilab_rl.envs.choices.base import WIDTH, ChoiceTask
from scilab_rl.errors import ConfigError

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

N_FORCED = 4
SD = 0.08  # 8 points
_BASES = (0.40, 0.60)
_DIFFERENCES = (0.04, 0.08, 0.12, 0.20, 0.30)
# States: 0 to 5 have so many free choices left after this one; 6 and 7 force left and right.
_FORCED_STATE = 6


class Horizon(ChoiceTask):
    """Four forced samples of two slot machines, then one free choice or six.

    The task of Wilson et al. (2014), J Exp Psychol Gen 143. Machines pay 1 to 100 points (here
    divided by 100), Gaussian with sd 8. One has a mean of 40 or 60, the other one of 4, 8, 12, 20
    or 30 more or less. The forced choices show both twice (equal information) or one of them once
    and the other three times. With six free choices left it is worth knowing more: people choose
    the less known machine more often (directed exploration), and more at random.

    A block is one game: nothing is carried over to the next. The columns ``horizon`` (1 or 6),
    ``information`` (forced samples of the right machine minus those of the left one) and the two
    means belong to each choice.

    Args:
        horizon: Free choices, 1 or 6; None draws one of them for each game.
        render_mode: ``rgb_array``, or None for no frames.
    """

    title = "Horizon"

    def __init__(self, horizon: int | None = None, render_mode: str | None = None) -> None:
        if horizon not in (None, 1, 6):
            raise ConfigError(f"env_kwargs.horizon must be 1, 6 or null, but it is {horizon}.")
        self.horizon = horizon
        self._free = horizon or 6
        super().__init__(
            ("left", "right"),
            n_states=_FORCED_STATE + 2,
            n_trials=N_FORCED + self._free,
            render_mode=render_mode,
        )

    def draw_block(self) -> None:
        """Draw the horizon, the means, the forced samples and all points."""
        self._free = self.horizon or int(self.np_random.choice((1, 6)))
        self.n_trials = N_FORCED + self._free
        base = self.np_random.choice(_BASES)
        other = base + self.np_random.choice((-1, 1)) * self.np_random.choice(_DIFFERENCES)
        self.means = self.np_random.permutation([base, other])
        n_right = int(self.np_random.choice((1, 2, 3)))
        samples = np.arange(N_FORCED) < n_right
        self.samples = self.np_random.permutation(samples).astype(int)
        self.information = 2 * n_right - N_FORCED
        points = np.round(self.np_random.normal(self.means, SD, (N_FORCED + 6, 2)), 2)
        self.outcomes = np.clip(points, 0.01, 1.0)
        self.history: list[tuple[int, float]] = []
        self.state = self._next_state()

    @property
    def forced(self) -> int | None:
        """The machine that must be sampled, in the first four trials."""
        return int(self.samples[self.trial]) if self.trial < N_FORCED else None

    def _next_state(self) -> int:
        if self.forced is not None:
            return _FORCED_STATE + self.forced
        return max(self.n_trials - self.trial - 1, 0)

    def respond(self, response: int) -> dict[str, float]:
        """Pay the points of a machine."""
        feedback = float(self.outcomes[self.row, response])
        self.history.append((response, feedback))
        self.trial += 1
        self.state = self._next_state()
        return {
            "feedback": feedback,
            "correct": int(self.means[response] >= self.means.max()),
            "horizon": self._free,
            "information": self.information,
            "mean_0": float(self.means[0]),
            "mean_1": float(self.means[1]),
        }

    def draw(self, pen: ImageDraw) -> None:
        """Draw both machines as columns, a box per trial, with the points that were seen."""
        height, top = 26, 70
        for machine, name in enumerate(self.action_names):
            x = WIDTH // 2 - 80 + machine * 120
            for trial in range(self.n_trials):
                y = top + trial * height
                seen = trial < len(self.history) and self.history[trial][0] == machine
                box = (x, y, x + 100, y + height - 4)
                pen.rounded_rectangle(box, 5, COLORS[machine] if seen else GRID, FRAME)
                if seen:
                    text = f"{100 * self.history[trial][1]:.0f}"
                    pen.text((x + 50, y + 11), text, BACKGROUND, font(14), anchor="mm")
                elif trial == self.trial and self.forced in (None, machine):
                    pen.rounded_rectangle(box, 5, BACKGROUND, INK, 2)
            pen.text((x + 50, top - 6), name, INK, font(14), anchor="ms")
        left = self.n_trials - self.trial
        text = "sampling" if self.forced is not None else f"{left} free choice{'s' * (left != 1)}"
        pen.text((24, 46), text, FAINT, font(16))
