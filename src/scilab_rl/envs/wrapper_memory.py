"""The state of an environment's wrappers, as plain data.

What a wrapper has seen in the running episode comes back when the episode is repeated. What it has
learned in earlier episodes, such as running means or counters, does not: it is saved from here.
"""

from __future__ import annotations

import copy
import types
from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np

_PLAIN = (bool, int, float, str, type(None))
# Their wrappers are ours or Gymnasium's own, and learn nothing.
_OWN_MODULES = ("gymnasium.wrappers.common", "scilab_rl.envs.stability")
_FUNCTIONS = (types.FunctionType, types.MethodType, types.BuiltinFunctionType, partial, np.ufunc)
_NOT_MEMORY = (gym.Env, gym.Space, types.ModuleType, type, np.dtype, *_FUNCTIONS)
BASE_ATTRIBUTES = (
    "env",
    "_action_space",
    "_observation_space",
    "_metadata",
    "_cached_spec",
    "_saved_kwargs",
)
_MOST_LEVELS = 12
UNKNOWN = ["unknown"]
# Attributes by wrapper and name, as lists that say what they hold, see `describe`.
Memory: TypeAlias = dict[str, dict[str, object]]


def memory_of(env: gym.Env) -> Memory:
    """Return the attributes of all wrappers that belong to the run, by the wrappers' names.

    What cannot be described as numbers, text, arrays and containers is marked as unknown.
    """
    return {
        name: {
            key: describe(value)
            for key, value in vars(wrapper).items()
            if key not in BASE_ATTRIBUTES and not isinstance(value, _NOT_MEMORY)
        }
        for name, wrapper in _wrappers(env)
    }


def set_memory(env: gym.Env, memory: Memory) -> None:
    """Give wrappers what `memory_of` returned; wrappers that are not there are left out."""
    for name, wrapper in _wrappers(env):
        for key, description in memory.get(name, {}).items():
            if key in vars(wrapper):
                setattr(wrapper, key, rebuilt(description, vars(wrapper)[key]))


def unknown_memory(memory: Memory) -> list[str]:
    """Return the names of the attributes that could not be described."""
    return [
        f"{name}.{key}"
        for name, attributes in memory.items()
        for key, description in attributes.items()
        if _has_unknown(description)
    ]


def is_plain(description: object) -> bool:
    """Return whether what was described has neither unknown parts nor objects of other classes."""
    if not isinstance(description, (list, tuple)) or not description:
        return True
    return description[0] not in (*UNKNOWN, "object") and all(map(is_plain, description))


def describe(value: object, levels: int = _MOST_LEVELS) -> object:
    """Return a copy of a value made of plain values, arrays and lists that say what they are."""
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, np.generic):
        return ["scalar", np.array(value)]
    if levels == 0:  # deeper than any sensible container: it may hold itself
        return UNKNOWN
    inside = partial(describe, levels=levels - 1)
    if isinstance(value, np.ndarray):
        return UNKNOWN if value.dtype.hasobject else ["array", value.copy()]
    if isinstance(value, dict):
        return ["dict", [[inside(key), inside(entry)] for key, entry in value.items()]]
    if isinstance(value, (list, tuple, deque, set)) and not hasattr(value, "_fields"):
        kind = next(kind for kind in (list, tuple, deque, set) if isinstance(value, kind))
        return [kind.__name__, [inside(entry) for entry in value]]
    if isinstance(value, np.random.Generator):
        return ["generator", describe(value.bit_generator.state)]
    if isinstance(value, _NOT_MEMORY) or not hasattr(value, "__dict__"):
        return UNKNOWN
    attributes = vars(value).items()
    return ["object", [[key, inside(entry)] for key, entry in attributes]]


def rebuilt(description: Any, current: Any) -> Any:
    """Return what was described; what is unknown stays as it is now."""
    if not isinstance(description, (list, tuple)):
        return description
    kind, *content = description
    if kind == "unknown":
        return current
    if kind in ("scalar", "array"):
        array = np.array(content[0])
        return array[()] if kind == "scalar" else array
    if kind in ("dict", "generator", "object"):
        return _rebuilt_with_names(kind, content[0], current)
    entries = [rebuilt(entry, None) for entry in content[0]]
    if kind == "deque":
        return deque(entries, maxlen=getattr(current, "maxlen", None))
    return {"list": list, "tuple": tuple, "set": set}[kind](entries)


def _rebuilt_with_names(kind: str, content: Any, current: Any) -> Any:
    if kind == "generator":
        current.bit_generator.state = rebuilt(content, None)
        return current
    olds = current if kind == "dict" else vars(current)
    entries = {}
    for described_key, entry in content:
        key = rebuilt(described_key, None)
        entries[key] = rebuilt(entry, olds.get(key) if isinstance(olds, dict) else None)
    if kind == "dict":
        return entries
    vars(current).update(entries)
    return current


def owned(value: Any) -> Any:
    """Return a copy that shares nothing that can change; faster than `copy.deepcopy`."""
    kind = type(value)
    if isinstance(value, _PLAIN) or isinstance(value, np.generic):
        return value
    if kind is np.ndarray and not value.dtype.hasobject:
        return value.copy()
    if kind is dict:
        return {key: owned(entry) for key, entry in value.items()}
    if kind in (list, tuple):
        return kind(owned(entry) for entry in value)
    return copy.deepcopy(value)


def _wrappers(env: gym.Env) -> Iterator[tuple[str, gym.Wrapper]]:
    """Yield the run's own wrappers from the outside in, with names that are unique."""
    seen: Counter[str] = Counter()
    while isinstance(env, gym.Wrapper):
        kind = type(env)
        if kind.__module__ not in _OWN_MODULES:
            seen[kind.__name__] += 1
            yield f"{kind.__name__}_{seen[kind.__name__]}", env
        env = env.env


def _has_unknown(description: object) -> bool:
    if not isinstance(description, (list, tuple)):
        return False
    return (
        list(description) == UNKNOWN
        if len(description) == 1
        else any(map(_has_unknown, description))
    )
