"""The base of choice tasks: trials, feedback, the columns of a trial, a picture of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.drawing import BACKGROUND, COLORS, FAINT, FRAME, GRID, INK, font
from scilab_rl.envs.choices.trial_space import TrialSpace
from scilab_rl.envs.types import Info, ResetResult, StepResult
from scilab_rl.errors import ConfigError

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

COLUMNS_KEY = "trial_columns"  # in the info of each step
WIDTH, HEIGHT = 480, 360


class ChoiceTask(gym.Env, ABC):
    """A block of trials. A subclass says which states and responses there are, and what they bring.

    A step is a choice; an episode is a block, at whose beginning nothing is known. All chance is
    drawn at the reset: with the same seed, the same choices bring the same feedback to everybody.
    The info of each step has, under ``trial_columns``, the columns of that choice in a table:
    ``trial``, ``stage``, ``state``, ``response``, ``feedback``, ``forced``, ``correct`` (whether
    no other response was better, 1 or 0) and those of the task.

    Args:
        action_names: Names of the responses, for people.
        n_states: States in which choices are made.
        n_stages: Choices per trial.
        n_trials: Trials of a block.
        render_mode: ``rgb_array``, or None for no frames.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - Gymnasium's name
    title: ClassVar[str]

    def __init__(
        self,
        action_names: tuple[str, ...],
        *,
        n_states: int = 1,
        n_stages: int = 1,
        n_trials: int,
        render_mode: str | None = None,
    ) -> None:
        if n_trials < 1:
            raise ConfigError(f"env_kwargs.n_trials must be at least 1, but it is {n_trials}.")
        self.action_names = action_names
        self.n_trials = n_trials
        self.render_mode = render_mode
        self.observation_space: TrialSpace = TrialSpace(n_states, len(action_names), n_stages)
        self.action_space: spaces.Discrete = spaces.Discrete(len(action_names))
        self._begin_block()

    def _begin_block(self) -> None:
        self.trial = 0
        self.state = 0
        self.last: dict[str, float] | None = None

    @abstractmethod
    def draw_block(self) -> None:
        """Draw from ``self.np_random`` all that is left to chance in a block."""

    @abstractmethod
    def respond(self, response: int) -> dict[str, float]:
        """Advance by a choice: set ``self.state`` and, when a trial is over, ``self.trial``.

        Returns:
            ``feedback`` in [-1, 1], and other columns of this choice.
        """

    @property
    def forced(self) -> int | None:
        """The only response that is allowed now; None where the choice is free."""
        return None

    @property
    def is_over(self) -> bool:
        """Whether the block has ended."""
        return self.trial >= self.n_trials

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin a block."""
        super().reset(seed=seed)
        self._begin_block()
        self.draw_block()
        return self.observation_space.encode(self.state, None, 0.0), {}

    def step(self, action: int) -> StepResult:
        """Make a choice.

        Args:
            action: The response, from 0; another than a forced one is replaced by that.
        """
        forced = self.forced
        response = int(action) if forced is None else forced
        columns: dict[str, float] = {
            "trial": self.trial,
            "stage": 0,
            "state": self.state,
            "response": response,
            "feedback": 0.0,
            "forced": int(forced is not None),
        }
        columns |= self.respond(response)
        self.last = columns
        feedback = columns["feedback"]
        observation = self.observation_space.encode(self.state, response, feedback)
        return observation, feedback, self.is_over, False, {COLUMNS_KEY: columns}

    @property
    def row(self) -> int:
        """The trial that counts for what was drawn for a block, also after its end."""
        return min(self.trial, self.n_trials - 1)

    def render(self) -> np.ndarray:
        """Draw the last choice, its feedback and the responses. Shapes: ``(360, 480, 3)``."""
        from PIL import Image, ImageDraw

        image = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
        pen = ImageDraw.Draw(image)
        pen.text((24, 20), self.title, INK, font(20))
        trial = f"{min(self.trial + 1, self.n_trials)} of {self.n_trials}"
        pen.text((WIDTH - 24, 22), trial, FAINT, font(16), anchor="ra")
        self.draw(pen)
        pen.rectangle((24, HEIGHT - 22, WIDTH - 24, HEIGHT - 16), GRID)
        done = min(self.trial / self.n_trials, 1.0) * (WIDTH - 48)
        pen.rectangle((24, HEIGHT - 22, 24 + done, HEIGHT - 16), INK)
        return np.asarray(image)

    def draw(self, pen: ImageDraw) -> None:
        """Draw the responses as cards, the last one framed, and its feedback above."""
        draw_cards(pen, self.action_names, self.last, colors=COLORS)


def draw_cards(
    pen: ImageDraw,
    names: tuple[str, ...],
    last: dict[str, float] | None,
    *,
    colors: tuple[str, ...],
    prompt: bool = True,
) -> None:
    """Draw a card per response; the one that was chosen last is framed and bears its feedback.

    Args:
        pen: Draws on a picture of 480 x 360 pixels.
        names: Names of the responses.
        last: Columns of the last choice; None before the first one.
        colors: Color of each card.
        prompt: Whether to ask for a choice before the first one.
    """
    gap = 16
    width = min(120, (WIDTH - 48 - gap * (len(names) - 1)) // len(names))
    left = (WIDTH - len(names) * (width + gap) + gap) // 2
    for index, name in enumerate(names):
        x = left + index * (width + gap)
        box = (x, 130, x + width, 270)
        chosen = last is not None and last["response"] == index
        pen.rounded_rectangle(box, 12, colors[index % len(colors)])
        pen.text((x + width / 2, 290), name, INK, font(16), anchor="ma")
        if chosen and last is not None:
            pen.rounded_rectangle((x - 6, 124, x + width + 6, 276), 16, outline=INK, width=3)
            text = feedback_text(last["feedback"])
            pen.text((x + width / 2, 200), text, BACKGROUND, font(36), anchor="mm")
    if last is None and prompt:
        pen.rounded_rectangle((24, 66, WIDTH - 24, 104), 8, GRID, FRAME)
        pen.text((WIDTH / 2, 85), "Choose", FAINT, font(16), anchor="mm")


def feedback_text(feedback: float) -> str:
    """Return feedback as it is drawn.

    >>> feedback_text(1.0), feedback_text(0.0), feedback_text(0.4712), feedback_text(-1.0)
    ('+1', '0', '47', '-1')
    """
    if feedback == int(feedback):
        return f"{int(feedback):+d}" if feedback else "0"
    return f"{100 * feedback:.0f}"


def random_walk(
    rng: np.random.Generator, shape: tuple[int, ...], *, sd: float, low: float, high: float
) -> np.ndarray:
    """Return Gaussian random walks along the first axis that are reflected at two bounds.

    Args:
        rng: Draws the starts, uniform between the bounds, and the steps.
        shape: ``(n_trials, ...)``.
        sd: Standard deviation of a step.
        low: Lower bound.
        high: Upper bound.

    Shapes:
        result: ``shape``.
    """
    walks = np.empty(shape)
    walks[0] = rng.uniform(low, high, shape[1:])
    steps = rng.normal(0.0, sd, shape)
    for trial in range(1, shape[0]):
        # A triangle wave of the unbounded walk is the reflected one.
        place = np.mod(walks[trial - 1] + steps[trial] - low, 2 * (high - low))
        walks[trial] = low + np.minimum(place, 2 * (high - low) - place)
    return walks
