"""A goal environment of numpy alone that does something wrong where it is told to."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.testing.environments import TinyReach

ID = "tests.faults.environment:Faulty-v0"
PLACES = ("init", "reset", "step", "render", "close")


class Faulty(TinyReach):
    """TinyReach with switches; without them, it is TinyReach.

    Args:
        fault: ``raise``, ``hang``, ``kill`` (the worker process), ``slow``, or what to return
            instead: ``nan``, ``inf``, ``short``, ``long``, ``text``, ``none``, ``missing``,
            ``number``, ``words``, ``outside``.
        place: ``init``, ``reset``, ``step``, ``render``, ``close``; for wrong values also
            ``observation``, ``achieved_goal``, ``desired_goal``, ``reward``, ``terminated``,
            ``truncated``, ``info``.
        at: At which call of ``step`` or ``reset``, from 1; wrong values come with steps, or with
            resets when ``in_reset``.
        once: A file that is made when the fault happens; where it exists, nothing does.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        fault: str = "",
        place: str = "step",
        at: int = 1,
        in_reset: bool = False,
        once: str = "",
        render_mode: str | None = None,
    ) -> None:
        super().__init__()
        self.render_mode = render_mode
        # The command line reads nan as a number.
        self.fault, self.place, self.at = str(fault), place, at
        self.in_reset, self.once = in_reset, once
        self._n = dict.fromkeys(PLACES, 0)
        self._happens("init")

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        observation, info = super().reset(seed=seed)
        self._happens("reset")
        if self.in_reset and self._n["reset"] == self.at:
            observation, _, _, _, info = self._spoil(observation, 0.0, False, False, info)
        return observation, info

    def step(self, action: Any) -> Any:
        result = super().step(action)
        self._happens("step")
        if not self.in_reset and self._n["step"] == self.at:
            result = self._spoil(*result)
        return result

    def render(self) -> np.ndarray:
        self._happens("render")
        return np.zeros((16, 16, 3), np.uint8)

    def close(self) -> None:
        self._happens("close")

    def _happens(self, place: str) -> None:
        self._n[place] += 1
        if self.fault == "slow" and place == "step":
            time.sleep(0.002)
        if place != self.place or self._n[place] != self.at or self._has_happened():
            return
        if self.fault == "raise":
            raise ValueError("the gripper broke\nand fell")
        if self.fault == "hang":
            time.sleep(1000 if not self.once else 3)
        if self.fault == "kill" and multiprocessing.current_process().daemon:
            os.kill(os.getpid(), signal.SIGKILL)

    def _has_happened(self) -> bool:
        if not self.once:
            return False
        try:
            os.close(os.open(self.once, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return True
        return False

    def _spoil(self, observation: Any, *rest: Any) -> Any:
        values = dict(zip(("reward", "terminated", "truncated", "info"), rest, strict=True))
        if self.place in observation:
            if self.fault == "missing":
                del observation[self.place]
            else:
                observation[self.place] = self._wrong(observation[self.place])
        elif self.place in values:
            values[self.place] = self._wrong(values[self.place])
        elif self.place == "whole" and self.fault:
            observation = self._wrong(observation["observation"])
        return (observation, *values.values())

    def _wrong(self, value: Any) -> Any:
        wrong = np.array(value, copy=True)
        match self.fault:
            case "nan" | "inf":
                if wrong.ndim:
                    wrong[1] = float(self.fault)
                return wrong if wrong.ndim else float(self.fault)
            case "short":
                return wrong[:1]
            case "long":
                return np.append(wrong, wrong)
            case "text":
                return np.array(["a"] * wrong.size)
            case "none":
                return None
            case "number":
                return 0.5
            case "words":
                return "yes"
            case "outside":
                return wrong + 10
            case _:
                return value


gym.register(
    "Faulty-v0", entry_point=f"{__name__}:Faulty", max_episode_steps=15, disable_env_checker=True
)
