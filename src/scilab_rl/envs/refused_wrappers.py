"""Wrappers that would give wrong numbers here, each with the way that gives right ones."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence

import gymnasium as gym
from gymnasium import wrappers
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from scilab_rl.errors import ConfigError

_RECORD = "it records outside the run; render=record keeps episodes with their metrics"
_REFUSED: dict[type, str] = {
    wrappers.NormalizeObservation: (
        "its running means differ in each environment and are neither shared with the evaluation "
        "nor frozen there; +normalize_obs=1 does it right"
    ),
    wrappers.NormalizeReward: (
        "its running means differ in each environment; +normalize_reward=1 does it right"
    ),
    wrappers.Autoreset: "it hides the ends of episodes; environments are reset here anyway",
    wrappers.RecordVideo: _RECORD,
    wrappers.RenderCollection: _RECORD,
    wrappers.HumanRendering: "it opens windows; use render=human or render=display",
    VecVideoRecorder: _RECORD,
    gym.vector.VectorWrapper: (
        "it wraps Gymnasium's own vectors; take the class of the same name in gymnasium.wrappers, "
        "or one of stable_baselines3.common.vec_env"
    ),
}


def refuse_wrapper(wrapper: Callable[..., object]) -> None:
    """Reject a wrapper that cannot give right numbers in training, evaluation and resumed runs.

    Args:
        wrapper: A class, a function, or one of them with bound arguments.

    Raises:
        ConfigError: With the reason and the way that works.
    """
    target = getattr(wrapper, "func", wrapper)
    if not inspect.isclass(target):
        return
    for refused, reason in _REFUSED.items():
        if issubclass(target, refused):
            raise ConfigError(f"wrappers: {target.__name__} is refused: {reason}.")


def refuse_order(wrappers: Sequence[Callable[..., object]]) -> None:
    """Reject what changes observations or rewards above `VecNormalize`.

    Replay buffers keep what is directly below that, which is then not what the agent has seen.

    Args:
        wrappers: In the order in which they are applied.

    Raises:
        ConfigError: With the order that works.
    """
    targets = [getattr(wrapper, "func", wrapper) for wrapper in wrappers]
    classes = [t for t in targets if inspect.isclass(t) and issubclass(t, VecEnvWrapper)]
    is_normalized = False
    for target in classes:
        if is_normalized and not issubclass(target, (VecMonitor, VecCheckNan)):
            raise ConfigError(
                f"wrappers: {target.__name__} is refused after VecNormalize: what is stored for "
                "learning would not be what the agent saw. List VecNormalize last, or take "
                "+normalize_obs=1."
            )
        is_normalized = is_normalized or issubclass(target, VecNormalize)
