"""CueMemory: what is shown, what counts, and what it takes to remember."""

from __future__ import annotations

import numpy as np
import pytest

from scilab_rl.envs.cue_memory import CueMemory
from scilab_rl.errors import ConfigError


def test_the_cue_is_shown_once_and_the_answer_counts_once() -> None:
    env = CueMemory(n_cues=3, delay=2)
    observation, _ = env.reset(seed=4)
    cue = int(np.argmax(observation[:3]))
    assert observation[:3].tolist() == np.eye(3)[cue].tolist()
    assert observation[4] == 0
    for asks in (0, 1):
        observation, reward, terminated, truncated, info = env.step(np.int64(cue))
        assert observation[[0, 1, 2, 4]].tolist() == [0, 0, 0, asks]
        assert (reward, terminated, truncated, info) == (0.0, False, False, {})
    *_, reward, terminated, _, info = env.step(np.int64(cue))
    assert (reward, terminated, info) == (1.0, True, {"is_success": True})


def test_a_wrong_answer_fails() -> None:
    env = CueMemory(n_cues=2, delay=1)
    observation, _ = env.reset(seed=4)
    wrong = 1 - int(np.argmax(observation[:2]))
    env.step(np.int64(wrong))
    assert env.step(np.int64(wrong))[1:] == (0.0, True, False, {"is_success": False})


def test_pictures_show_cue_delay_and_question() -> None:
    env = CueMemory(delay=2, render_mode="rgb_array")
    env.reset(seed=1)
    pictures = [env.render()]
    for _ in range(2):
        env.step(np.int64(0))
        pictures.append(env.render())
    colors = [tuple(picture[0, 0].tolist()) for picture in pictures]
    assert colors[1:] == [(230, 230, 230), (60, 60, 60)]
    assert len(set(colors[0])) > 1


def test_impossible_tasks_are_refused() -> None:
    with pytest.raises(ConfigError, match="delay must be at least 1"):
        CueMemory(delay=0)
    with pytest.raises(ConfigError, match="n_cues must be one of 2, 3, 4"):
        CueMemory(n_cues=5)
