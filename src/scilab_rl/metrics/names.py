"""The names of metrics: those that every run has, and what is said about one that no run has."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping

from scilab_rl.errors import ConfigError, did_you_mean, listing

EVAL_METRICS = (
    "eval/success_rate",
    "eval/success_once_rate",
    "eval/mean_reward",
    "eval/mean_ep_length",
    "eval/rollout_rewards_step",
)
# Recorded by the framework, whatever the algorithm is.
FRAMEWORK_METRICS = (
    *EVAL_METRICS,
    "rollout/success_rate",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "train/rollout_rewards_step",
    "env/unstable_episodes",
    "time/total_timesteps",
    "time/fps",
    "time/train_seconds",
    "time/eval_seconds",
)
# The same, of algorithms that give themselves a reward.
INTRINSIC_METRICS = ("train/intrinsic_reward_step", "rollout/intrinsic_ep_rew_mean")


def is_recorded(name: str, recorded: Iterable[str]) -> bool:
    """Return whether a name is among others, or matches a pattern of them such as ``train/x_*``."""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in recorded)


def refuse_absent(key: str, name: str, absent: Mapping[str, str], algorithm_name: str) -> None:
    """Reject a metric that an algorithm records in other configurations only.

    Raises:
        ConfigError: With the condition under which it is recorded.
    """
    for pattern, condition in absent.items():
        if fnmatch.fnmatchcase(name, pattern):
            raise ConfigError(f"{key}: {algorithm_name} records '{name}' only when {condition}.")


def check_recorded(
    key: str,
    name: str,
    recorded: Iterable[str],
    *,
    absent: Mapping[str, str],
    algorithm_name: str,
    hint: str = "",
) -> None:
    """Reject a metric that a run never records.

    Args:
        key: The configuration's key that names it.
        name: The metric.
        recorded: Names and patterns that the run records.
        absent: Those that it would record in another configuration, and in which.
        algorithm_name: The algorithm's name.
        hint: What else can be done.

    Raises:
        ConfigError: With the names that there are.
    """
    known = set(recorded)
    refuse_absent(key, name, absent, algorithm_name)
    if not is_recorded(name, known):
        words = [word for word in known if "*" not in word]
        raise ConfigError(
            f"{key}: {algorithm_name} records no '{name}'.{did_you_mean(name, words)} There are "
            f"{listing(known, limit=40)}.{hint}"
        )
