"""Checking the keyword arguments of an algorithm before anything is built."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping

from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.learning.values import constructor_parameters, takes_schedule

# Given by the framework, never by the user's YAML.
FRAMEWORK_PARAMETERS = ("policy", "env", "seed", "device", "verbose", "tensorboard_log")
_HIDDEN = ("self", "_init_setup_model", "env", "seed", "device", "verbose", "tensorboard_log")

# Off-policy algorithms of Stable-Baselines3 take it too, see `intrinsic.build`.
INTRINSIC = "intrinsic"
# Off-policy algorithms take demonstrations through their replay buffer, see `run.demonstrations`.
DEMOS = "demos"
DATA = "data"  # of offline algorithms, in the same module

_FRACTION = (0.0, 1.0)
_POSITIVE = (math.ulp(0.0), math.inf)
_AT_LEAST_1 = (1, math.inf)
_AT_LEAST_0 = (0, math.inf)
# Parameters whose meaning is the same in all algorithms of the field, and their range.
RANGES: dict[str, tuple[float, float]] = {
    "gamma": _FRACTION,
    "tau": _FRACTION,
    "gae_lambda": _FRACTION,
    "exploration_fraction": _FRACTION,
    "exploration_initial_eps": _FRACTION,
    "exploration_final_eps": _FRACTION,
    "weight_critic_var": _FRACTION,
    "random_actions": _FRACTION,
    "random_actions_end": _FRACTION,
    "expectile": _FRACTION,
    "learning_rate": _POSITIVE,
    "batch_size": _AT_LEAST_1,
    "buffer_size": _AT_LEAST_1,
    "n_critics": _AT_LEAST_1,
    "n_target_critics": _AT_LEAST_1,
    "n_steps": _AT_LEAST_1,
    "n_epochs": _AT_LEAST_1,
    "policy_delay": _AT_LEAST_1,
    "target_update_interval": _AT_LEAST_1,
    "learning_starts": _AT_LEAST_0,
    "bc_weight": _AT_LEAST_0,
    "inverse_temperature": _AT_LEAST_0,
    "max_grad_norm": _POSITIVE,
    "clip_range": _POSITIVE,
}


def allowed_arguments(cls: Callable[..., object]) -> list[str]:
    """Return the keyword arguments that a user may set, in the constructor's order."""
    names = [name for name in constructor_parameters(cls) if name not in _HIDDEN]
    if takes_intrinsic_reward(cls) and INTRINSIC not in names:
        names.append(INTRINSIC)
    if takes_demos(cls) and DEMOS not in names:
        names.append(DEMOS)
    return names


def takes_demos(cls: Callable[..., object]) -> bool:
    """Return whether ``algorithm.demos`` works: where there is a replay buffer."""
    return inspect.isclass(cls) and "replay_buffer_class" in constructor_parameters(cls)


def takes_intrinsic_reward(cls: Callable[..., object]) -> bool:
    """Return whether ``algorithm.intrinsic`` works: by a parameter, or through a replay buffer."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    is_off_policy = inspect.isclass(cls) and issubclass(cls, OffPolicyAlgorithm)
    return is_off_policy or accepts(cls, INTRINSIC)


def accepts(cls: Callable[..., object], name: str) -> bool:
    """Return whether the constructor has a parameter of this name."""
    return name in constructor_parameters(cls)


def check_arguments(name: str, cls: Callable[..., object], arguments: Mapping[str, object]) -> None:
    """Reject unknown arguments and values outside their range.

    Args:
        name: The algorithm's name, for the message.
        cls: Its class.
        arguments: What the configuration gives.

    Raises:
        ConfigError: With the allowed names or the allowed range.
    """
    allowed = allowed_arguments(cls)
    for argument, value in arguments.items():
        if argument not in allowed:
            raise ConfigError(
                f"The algorithm '{name}' has no parameter algorithm.{argument}."
                f"{did_you_mean(argument, allowed)} It has: {listing(allowed, limit=40)}."
            )
        _check_range(argument, value)
        if accepts(cls, argument):
            _check_type(argument, value, cls)


def _check_range(argument: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return
    low, high = RANGES.get(argument, (-math.inf, math.inf))
    if math.isnan(value) or not low <= value <= high:
        if (low, high) == _POSITIVE:
            wanted = "greater than 0"
        elif high == math.inf:
            wanted = f"at least {low:g}" if low > -math.inf else "a number"
        else:
            wanted = f"from {low:g} to {high:g}"
        raise ConfigError(f"algorithm.{argument} must be {wanted}, but it is {value}.")


def _check_type(argument: str, value: object, cls: Callable[..., object]) -> None:
    """Compare with the type of the default: a number cannot be replaced by a word.

    Words that a parameter understands (``auto``, ``auto_0.1``) are left to the algorithm when its
    annotation allows text.
    """
    parameter = constructor_parameters(cls)[argument]
    default, annotation = parameter.default, str(parameter.annotation)
    is_number = isinstance(default, (int, float)) and not isinstance(default, bool)
    takes_words = "str" in annotation or "tuple" in annotation or takes_schedule(annotation)
    if is_number and isinstance(value, (str, list)) and not takes_words:
        raise ConfigError(f"algorithm.{argument} must be a number, but it is {value!r}.")
    if isinstance(default, bool) and not isinstance(value, bool) and value not in (0, 1):
        raise ConfigError(f"algorithm.{argument} must be true or false, but it is {value!r}.")
    whole = isinstance(default, int) and is_number and "float" not in annotation
    if whole and isinstance(value, float) and not value.is_integer():
        raise ConfigError(f"algorithm.{argument} must be a whole number, but it is {value}.")
