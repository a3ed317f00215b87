"""Values that Stable-Baselines3 documents and YAML cannot hold: tuples, schedules, classes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping

from stable_baselines3.common.utils import LinearSchedule

from scilab_rl.config.classes import class_name, find_target
from scilab_rl.errors import ConfigError

Build = Callable[[Mapping[str, object], str], object]
_FREQUENCY = re.compile(r"[(\[]?\s*(\d+)\s*[, ]\s*['\"]?(step|episode)['\"]?\s*[)\]]?")
_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
_LINEAR = re.compile(r"lin_(\d+\.?\d*(?:e[+-]?\d+)?)", re.IGNORECASE)


def documented_values(
    cls: Callable[..., object], arguments: Mapping[str, object], build: Build
) -> dict[str, object]:
    """Return keyword arguments with the values that the constructor is documented to take.

    ``[1, episode]`` becomes the tuple of a frequency, ``lin_1e-3`` a learning rate (or clip range)
    that goes down to 0 in a straight line, ``torch.nn.Tanh`` the class where a class is wanted.

    Args:
        cls: The algorithm.
        arguments: As the configuration has them.
        build: Makes the object of a mapping with a ``_target_``, which stands at the given key.

    Raises:
        ConfigError: If a value cannot be one of these, or a class cannot be found.
    """
    parameters = constructor_parameters(cls)
    found: dict[str, object] = {}
    for name, value in arguments.items():
        annotation = str(parameters[name].annotation) if name in parameters else ""
        if "tuple[int, str]" in annotation and isinstance(value, (str, list)):
            found[name] = _frequency(name, value)
        elif takes_schedule(annotation) and isinstance(value, str):
            found[name] = _schedule(name, value)
        else:
            found[name] = _built(name, value, f"algorithm.{name}", build)
    return found


def constructor_parameters(cls: Callable[..., object]) -> dict[str, inspect.Parameter]:
    """Return the parameters of a constructor by name, in its order.

    Where it passes ``**kwargs`` on, those of the class that it is made from follow.
    """
    found: dict[str, inspect.Parameter] = {}
    calls: list[Callable[..., object]] = [cls]
    if isinstance(cls, type):
        calls = [vars(c)["__init__"] for c in cls.__mro__ if "__init__" in vars(c)]
    for call in calls:
        parameters = inspect.signature(call).parameters.values()
        found |= {p.name: p for p in parameters if p.kind in _NAMED and p.name not in found}
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            break
    found.pop("self", None)
    return found


def takes_schedule(annotation: str) -> bool:
    """Return whether a parameter may be a function of the remaining progress."""
    return "Schedule" in annotation or "Callable" in annotation


def _frequency(name: str, value: str | list[object]) -> tuple[int, str]:
    words = value if isinstance(value, str) else " ".join(map(str, value))
    match = _FREQUENCY.fullmatch(words.strip())
    if match is None or int(match[1]) < 1:
        raise ConfigError(
            f"algorithm.{name} must be a number of steps, [N, step] or [N, episode], but it is "
            f"{value!r}."
        )
    return int(match[1]), match[2]


def _schedule(name: str, value: str) -> LinearSchedule:
    match = _LINEAR.fullmatch(value.strip())
    if match is None or float(match[1]) == 0:
        raise ConfigError(
            f"algorithm.{name} must be a number, or lin_NUMBER to go down to 0 in a straight line, "
            f"but it is {value!r}."
        )
    return LinearSchedule(float(match[1]), 0.0, 1.0)


def _built(key: str, value: object, path: str, build: Build) -> object:
    """Return the value with classes in place of their names, and objects that were built."""
    name = class_name(key, value)
    if name is not None:
        return _class(name, path)
    if isinstance(value, list):
        return [_built(key, entry, path, build) for entry in value]
    if not isinstance(value, Mapping):
        return value
    if "_target_" in value:
        return build(value, path)
    return {k: _built(str(k), v, f"{path}.{k}", build) for k, v in value.items()}


def _class(name: str, path: str) -> type:
    found = find_target(name, path)
    if not inspect.isclass(found):
        raise ConfigError(f"{path} must be a class, but {name} is not one.")
    return found
