"""A grid with a hidden goal: nothing pays until it is found, so that curiosity does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scilab_rl.drawing import BACKGROUND, COLORS, FRAME, GRID, REACHED
from scilab_rl.envs.choices.base import WIDTH, ChoiceTask
from scilab_rl.envs.types import Info, ResetResult, StepResult
from scilab_rl.errors import ConfigError

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

_MOVES = ((0, -1), (1, 0), (0, 1), (-1, 0))  # up, right, down, left


class HiddenGoal(ChoiceTask):
    """Walk in a grid until the cell is found that pays 1; it cannot be seen and moves each episode.

    Whoever revisits cells loses time: the shortest search visits each cell once. Exploring such
    grids for what is new is the simplest case of count-based curiosity (Bellemare et al., 2016).
    The state is the cell, row by row from the upper left corner; walks begin anywhere. The
    column ``visits`` says how often the cell that was entered had been visited before.

    Args:
        size: Cells per side, from 2 to 20.
        n_trials: Steps until an episode ends.
        render_mode: ``rgb_array``, or None for no frames.
    """

    title = "Hidden goal"

    def __init__(self, size: int = 5, n_trials: int = 50, render_mode: str | None = None) -> None:
        if not 2 <= size <= 20:
            raise ConfigError(f"env_kwargs.size must be from 2 to 20, but it is {size}.")
        self.size = size
        super().__init__(
            ("up", "right", "down", "left"),
            n_states=size * size,
            n_trials=n_trials,
            render_mode=render_mode,
        )

    def draw_block(self) -> None:
        """Draw the start, and hide the goal anywhere else."""
        start, goal = self.np_random.choice(self.size**2, 2, replace=False)
        self.state, self.goal = int(start), int(goal)
        self.visits = [0] * self.size**2
        self.visits[self.state] = 1

    @property
    def is_over(self) -> bool:
        """Whether the goal is found, or the time is up."""
        return self.state == self.goal or super().is_over

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin in another cell; the goal is not found yet."""
        observation, info = super().reset(seed=seed, options=options)
        return observation, info | {"is_success": False}

    def step(self, action: int) -> StepResult:
        """Move to the next cell; a wall holds."""
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, info | {"is_success": float(reward) > 0}

    def respond(self, response: int) -> dict[str, float]:
        """Enter a cell."""
        x, y = self.state % self.size, self.state // self.size
        dx, dy = _MOVES[response]
        x, y = min(max(x + dx, 0), self.size - 1), min(max(y + dy, 0), self.size - 1)
        self.state = y * self.size + x
        visits = self.visits[self.state]
        self.visits[self.state] += 1
        self.trial += 1
        found = self.state == self.goal
        return {"feedback": float(found), "correct": int(found or visits == 0), "visits": visits}

    def draw(self, pen: ImageDraw) -> None:
        """Draw the cells that were visited, the walker, and the goal once it is found."""
        cell = 260 // self.size
        left = (WIDTH - cell * self.size) // 2
        for index in range(self.size**2):
            x, y = left + index % self.size * cell, 64 + index // self.size * cell
            found = self.state == self.goal == index
            color = REACHED if found else (FRAME if self.visits[index] else BACKGROUND)
            pen.rectangle((x, y, x + cell, y + cell), color, GRID)
            if index == self.state:
                margin = cell * 0.22
                box = (x + margin, y + margin, x + cell - margin, y + cell - margin)
                pen.ellipse(box, COLORS[0])
