"""The classes and objects that a configuration names."""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Mapping
from typing import Any

from scilab_rl.errors import ConfigError, MissingDependencyError, did_you_mean

# Arguments that name a class, in addition to those that end in _class.
_CLASS_KEYS = ("activation_fn", "policy")
_DOTTED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")


def class_name(key: str, value: object) -> str | None:
    """Return the name that an entry of a configuration gives for a class, or None.

    >>> class_name("activation_fn", "torch.nn.Tanh")
    'torch.nn.Tanh'
    >>> class_name("optimizer_class", {"_target_": "torch.optim.AdamW"})
    'torch.optim.AdamW'
    >>> class_name("policy", "MlpPolicy")
    """
    if not (key.endswith("_class") or key in _CLASS_KEYS):
        return None
    if isinstance(value, Mapping) and set(value) == {"_target_"}:
        value = value["_target_"]
    return value if isinstance(value, str) and _DOTTED.fullmatch(value) else None


def find_target(target: object, key: str) -> Any:
    """Import ``package.module.Class``.

    Args:
        target: Its name.
        key: The key that names it, for messages.

    Raises:
        ConfigError: If there is none of this name, or its module cannot be imported.
        MissingDependencyError: If a package of an extra is missing for it.
    """
    if not isinstance(target, str) or not _DOTTED.fullmatch(target):
        raise ConfigError(f"{key} must be like package.module.Class, but it is {target!r}.")
    module_name, _, name = target.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise _explained(error, target, key) from error
    if not hasattr(module, name):
        classes = [word for word in vars(module) if isinstance(vars(module)[word], type)]
        raise ConfigError(
            f"{key}: there is no '{name}' in {module_name}.{did_you_mean(name, classes)}"
        )
    return getattr(module, name)


def build(value: object, key: str, *, is_partial: bool = False) -> Any:
    """Build the object of a mapping with a ``_target_``, and those inside of it.

    ``_args_`` are positional arguments, ``_partial_: true`` binds the arguments without the call.

    Args:
        value: The mapping; anything else comes back as it is.
        key: The key that it stands at, for messages.
        is_partial: Whether to bind the arguments of the outermost without the call.

    Raises:
        ConfigError: If there is no such class, or it refuses its arguments.
    """
    if isinstance(value, (list, tuple)):
        return [build(entry, key) for entry in value]
    if is_partial and (not isinstance(value, Mapping) or "_target_" not in value):
        raise ConfigError(f"Each entry of {key} needs a _target_, but there is {value!r}.")
    if not isinstance(value, Mapping):
        return value
    built = {str(name): build(entry, f"{key}.{name}") for name, entry in value.items()}
    if "_target_" not in built:
        return built
    target = find_target(built.pop("_target_"), f"{key}._target_")
    is_partial = bool(built.pop("_partial_", is_partial))
    arguments = built.pop("_args_", ())
    if is_partial:
        return functools.partial(target, *arguments, **built)
    try:
        return target(*arguments, **built)
    except Exception as error:
        raise ConfigError(f"{key}: {type(error).__name__}: {error}") from error


def missing_package(error: BaseException | None, target: str) -> MissingDependencyError | None:
    """Return the error about a package of an extra, if a class cannot be imported for that reason.

    Args:
        error: What the import has raised.
        target: The name of the class.
    """
    while error is not None:
        if isinstance(error, ImportError) and error.name in ("jax", "optax"):
            purpose = f"for the compiled algorithms, such as {target.split('.')[-2]}"
            return MissingDependencyError(error.name, "jax", purpose)
        error = error.__cause__
    return None


def _explained(error: Exception, target: str, key: str) -> ConfigError:
    if (missing := missing_package(error, target)) is not None:
        return missing
    kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
    return ConfigError(
        f"{key}: '{target}' cannot be imported: {kind}{error}. The class in "
        "src/custom_algorithms/my_idea.py is custom_algorithms.my_idea.CLASS."
    )
