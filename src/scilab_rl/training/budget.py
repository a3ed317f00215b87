"""Whether a run is long enough for its algorithm to learn; checked before the first step."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from scilab_rl.config.schema import RunConfig
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.compatibility import longest_episode
from scilab_rl.learning.replay import HindsightReplayBuffer

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FirstUpdate:
    """When an algorithm learns for the first time.

    Attributes:
        step: Environment steps before it, over all environments.
        reason: The numbers that it follows from.
        is_certain: Whether it cannot come earlier.
    """

    step: int
    reason: str
    is_certain: bool = True


def check_budget(cfg: RunConfig, algorithm: Algorithm) -> None:
    """Reject a run in which nothing could be learned or measured as it was asked for.

    Args:
        cfg: The configuration of the run.
        algorithm: Built, with its environments.

    Raises:
        ConfigError: With the numbers and what to change.
    """
    n_envs, epoch_steps = algorithm.get_env().num_envs, cfg.eval_after_n_steps
    if epoch_steps < n_envs:
        raise ConfigError(
            f"An epoch of eval_after_n_steps={epoch_steps} is shorter than one step of "
            f"n_envs={n_envs} environments; use eval_after_n_steps={n_envs} or more, or "
            f"n_envs={epoch_steps} or fewer."
        )
    if getattr(algorithm, "learns_offline", False):
        return  # its data are there before the first update
    _check_buffer(algorithm)
    _tell_large_batch(algorithm, n_envs)
    first = first_update(algorithm)
    # The run stops with the step that ends its last epoch, before the update that would follow.
    end = math.ceil(cfg.total_steps / n_envs) * n_envs
    if first is None or first.step < end:
        return
    problem = (
        f"{cfg.algorithm.name} would never learn: its first update comes after step {first.step} "
        f"({first.reason}), but the run ends at step {end} (eval_after_n_steps="
        f"{epoch_steps} x n_epochs={cfg.n_epochs})."
    )
    if cfg.require_updates and first.is_certain:
        raise ConfigError(
            f"{problem} Use eval_after_n_steps={first.step // cfg.n_epochs + 1} or more, or "
            "smaller numbers for the algorithm; require_updates=false trains nevertheless."
        )
    _log.warning("%s", problem if first.is_certain else problem.replace("would", "may"))


def first_update(algorithm: Algorithm) -> FirstUpdate | None:
    """Return when an algorithm first learns, or None where its parameters do not say.

    ``learning_starts``, ``train_freq`` and ``n_steps`` mean the same in all algorithms.
    """
    n_envs = algorithm.get_env().num_envs
    starts, n_steps = (getattr(algorithm, key, None) for key in ("learning_starts", "n_steps"))
    if isinstance(starts, (int, float)):
        return _first_off_policy_update(algorithm, int(starts), n_envs)
    if isinstance(n_steps, int):
        return FirstUpdate(n_steps * n_envs, f"n_steps={n_steps} x n_envs={n_envs}")
    return None


def _first_off_policy_update(algorithm: Algorithm, starts: int, n_envs: int) -> FirstUpdate:
    frequency, episodes = getattr(algorithm, "train_freq", 1), False
    if isinstance(frequency, TrainFreq):
        episodes = frequency.unit == TrainFrequencyUnit.EPISODE
        frequency = frequency.frequency
    reason = f"learning_starts={starts}, train_freq={frequency}{' episodes' if episodes else ''}"
    if episodes:  # they may also end before the step limit
        frequency *= longest_episode(algorithm.get_env()) or 1
    period = frequency * n_envs
    step = (starts // period + 1) * period
    return FirstUpdate(step, f"{reason}, n_envs={n_envs}", is_certain=not episodes)


def _check_buffer(algorithm: Algorithm) -> None:
    """Reject a buffer of episodes that loses the last whole one while the next one runs."""
    buffer, env = getattr(algorithm, "replay_buffer", None), algorithm.get_env()
    longest = longest_episode(env)
    if not isinstance(buffer, HerReplayBuffer) or longest is None:
        return
    rows = longest + isinstance(buffer, HindsightReplayBuffer)  # with its last observation
    needed = 2 * rows * env.num_envs
    given = buffer.buffer_size * env.num_envs
    if given < needed:
        raise ConfigError(
            f"Hindsight experience replay learns from whole episodes: algorithm.buffer_size must "
            f"hold an ended and a running one of {longest} steps for each of n_envs="
            f"{env.num_envs} environments, {needed} or more, but it holds {given}."
        )


def _tell_large_batch(algorithm: Algorithm, n_envs: int) -> None:
    batch_size = getattr(algorithm, "batch_size", None)
    buffer = getattr(algorithm, "replay_buffer", None)
    n_steps = getattr(algorithm, "n_steps", None)
    if buffer is not None:
        available, what = buffer.buffer_size * n_envs, "algorithm.buffer_size"
    elif isinstance(n_steps, int):
        available, what = n_steps * n_envs, f"a rollout of n_steps={n_steps} x n_envs={n_envs}"
    else:
        return
    if isinstance(batch_size, int) and batch_size > available:
        _log.warning(
            "algorithm.batch_size=%d is more than the %d steps of %s; a batch has no more "
            "different ones.", batch_size, available, what,
        )  # fmt: skip
