"""CueMemory: a cue at the first step has to be answered some steps later, from memory."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.envs.goal import require_choice
from scilab_rl.envs.types import Info, ResetResult, StepResult
from scilab_rl.errors import ConfigError

_SIDE = 96  # of the picture, in pixels
_COLORS = np.array(
    [[213, 94, 0], [0, 114, 178], [0, 158, 115], [204, 121, 167]], np.uint8
)  # of the cues: colors that color-blind people can tell apart
_BLANK, _QUESTION = 230, 60  # gray values


class CueMemory(gym.Env):
    """Remember which of several cues was shown, and answer when asked.

    The first observation shows the cue, those of the delay show nothing, and the last one asks.
    Only the action at the question counts: it brings reward 1 and success if it is the number of
    the cue, 0 otherwise, and ends the episode. A policy without memory cannot do better than guess:
    its success is 1 / n_cues.

    The observation has an entry for each cue, 1 while it is shown; one of noise from 0 to 1, which
    memory has to ignore; and one that is 1 at the question. Shapes: ``(n_cues + 2,)``.

    Args:
        n_cues: Different cues, from 2 to 4.
        delay: Steps from the cue to the question, at least 1. An episode has ``delay + 1`` steps;
            from 100 on, ``env_kwargs.max_episode_steps`` has to allow so many.
        render_mode: ``rgb_array`` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 - Gymnasium's

    def __init__(self, n_cues: int = 4, delay: int = 8, *, render_mode: str | None = None) -> None:
        require_choice("n_cues", n_cues, range(2, len(_COLORS) + 1))
        if delay < 1:
            raise ConfigError(f"env_kwargs.delay must be at least 1, but it is {delay!r}.")
        self.n_cues, self.delay, self.render_mode = n_cues, delay, render_mode
        self.action_space = spaces.Discrete(n_cues)
        self.observation_space = spaces.Box(0.0, 1.0, (n_cues + 2,), np.float32)
        self._cue = self._step = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Draw a cue and show it."""
        super().reset(seed=seed)
        self._cue = int(self.np_random.integers(self.n_cues))
        self._step = 0
        return self._observe(), {}

    def step(self, action: np.int64) -> StepResult:
        """Wait, or answer.

        Args:
            action: The number of a cue; it counts only at the question.
        """
        is_answer = self._step == self.delay
        right = is_answer and int(action) == self._cue
        self._step += 1
        info = {"is_success": right} if is_answer else {}
        return self._observe(), float(right), is_answer, False, info

    def render(self) -> np.ndarray | None:
        """Draw a field: colored for a cue, light for the delay, dark for the question."""
        if self.render_mode is None:
            return None
        picture = np.full((_SIDE, _SIDE, 3), _BLANK, np.uint8)
        if self._step == 0:
            picture[:] = _COLORS[self._cue]
        elif self._step >= self.delay:
            picture[:] = _QUESTION
        return picture

    def _observe(self) -> np.ndarray:
        observation = np.zeros(self.n_cues + 2, np.float32)
        if self._step == 0:
            observation[self._cue] = 1.0
        observation[-2] = self.np_random.random()
        observation[-1] = self._step == self.delay
        return observation
