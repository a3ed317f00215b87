"""The complete state of a learning algorithm as plain data: tensors, arrays and JSON.

`capture` walks through the attributes of an object and describes each one; `restore` puts the
description back into an object that was built the same way. Nothing in a description is ever
executed, and only attributes that the object already has are set. One mechanism serves every
algorithm, so that an idea that adds a network or a counter is saved without a line of code.

What is captured: tensors, modules, optimizers, arrays, numbers, text, containers of these, random
generators, and objects of the packages that algorithms are made of (replay buffers, noise,
normalization). What is not: environments, loggers, functions, spaces apart from their generators.
"""

from __future__ import annotations

import copy
import random
import sys
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.buffers import BaseBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.vec_env import VecEnv
from torch.optim.lr_scheduler import LRScheduler

from scilab_rl.errors import CheckpointError
from scilab_rl.metrics.logger import MetricLogger

Node = Any  # JSON: a plain value, or {"@kind": ...}
RandomState = dict[str, Any]  # of the global generators

_OPEN_PACKAGES = ("stable_baselines3", "sb3_contrib", "scilab_rl", "custom_algorithms")
# What a recurrent policy remembers of the running episodes: it belongs to them, not to the policy,
# which may act in another number of environments.
_OF_EPISODES = ("_last_lstm_states",)
# State of a module other than parameters and buffers: counters, running means, exploration.
_KEPT_IN_MODULES = (
    bool, int, float, np.ndarray, torch.Tensor, np.random.Generator, torch.optim.Optimizer,
    StateDependentNoiseDistribution,
)  # fmt: skip
_CLOSED = (VecEnv, gym.Env, MetricLogger, BaseCallback, torch.device, torch.dtype, type)


@dataclass
class Snapshot:
    """A captured state.

    Attributes:
        tree: The JSON description; refers to tensors and arrays by name.
        tensors: Parameters, optimizer moments and other tensors.
        arrays: NumPy arrays; replay buffers are views, not copies.
    """

    tree: Node = None
    tensors: dict[str, torch.Tensor] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)

    def copy(self) -> Snapshot:
        """Return a copy that later steps do not change."""
        return Snapshot(
            copy.deepcopy(self.tree),
            {name: tensor.clone() for name, tensor in self.tensors.items()},
            {name: array.copy() for name, array in self.arrays.items()},
        )


def capture(state: Mapping[str, object], *, with_buffers: bool = True) -> Snapshot:
    """Describe named objects.

    Args:
        state: Name to object, for example ``{"algorithm": model}``.
        with_buffers: Whether replay buffers are included.
    """
    snapshot = Snapshot()
    walker = _Capture(snapshot, with_buffers, _packages_of(state))
    snapshot.tree = {name: walker.describe(value, name) for name, value in state.items()}
    return snapshot


def restore(state: Mapping[str, object], snapshot: Snapshot) -> dict[str, Any]:
    """Put a captured state back.

    Args:
        state: Name to object, built as those that were captured; changed in place.
        snapshot: From `capture`, perhaps in another process.

    Returns:
        Name to restored value; differs from ``state`` for values that cannot change in place.

    Raises:
        CheckpointError: If the snapshot does not fit the objects.
    """
    walker = _Restore(snapshot)
    try:
        return {
            name: walker.put(state.get(name), node)
            for name, node in snapshot.tree.items()
            if name in state
        }
    except (AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"The saved state does not fit this algorithm: {error}") from error


def random_state() -> RandomState:
    """Return the state of the global generators of Python, NumPy and PyTorch."""
    version, words, gauss = random.getstate()
    kind, keys, position, has_gauss, cached = np.random.get_state()
    state: RandomState = {
        "python": [version, list(words), gauss],
        "numpy": [kind, np.asarray(keys), position, has_gauss, cached],
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def set_random_state(state: RandomState) -> None:
    """Set the global generators to a state from `random_state`."""
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    np.random.set_state(tuple(state["numpy"]))
    torch.set_rng_state(state["torch"])
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])


def _packages_of(state: Mapping[str, object]) -> tuple[str, ...]:
    """Return the packages whose objects are walked into: ours, and the algorithm's own."""
    own = {type(value).__module__.partition(".")[0] for value in state.values()}
    return (*_OPEN_PACKAGES, *(own - {"builtins", "numpy", "torch", "collections"}))


class Rows(NamedTuple):
    """How many rows of a replay buffer's arrays hold something, and how many there are."""

    filled: int
    capacity: int


class _Capture:
    def __init__(self, snapshot: Snapshot, with_buffers: bool, packages: tuple[str, ...]) -> None:
        self.snapshot = snapshot
        self.with_buffers = with_buffers
        self.packages = packages
        self.seen: set[int] = set()

    def describe(self, value: object, path: str, rows: Rows | None = None) -> Node:
        """Describe one value; ``rows`` tells how full the replay buffer is that it belongs to."""
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, torch.Tensor) or _is_jax_array(value):
            return self._tensor(value, path)
        if isinstance(value, np.ndarray):
            return self._array(value, path, rows)
        if isinstance(value, (dict, list, tuple, deque)):
            return self._container(value, path, rows)
        if isinstance(value, _CLOSED) or id(value) in self.seen:
            return {"@kind": "skip"}
        self.seen.add(id(value))
        for kinds, describe in self._object_kinds():
            if isinstance(value, kinds):
                return describe(value, path)
        if hasattr(value, "__dict__") and type(value).__module__.startswith(self.packages):
            return self._object(value, path)
        return {"@kind": "skip"}

    def _object_kinds(self) -> list[tuple[type, Callable[[Any, str], Node]]]:
        return [
            (torch.nn.Module, self._module),
            (torch.optim.Optimizer, self._optimizer),
            (LRScheduler, self._scheduler),
            (np.random.Generator, self._generator),
            (torch.Generator, self._torch_generator),
            (gym.Space, lambda s, path: self._generator(s.np_random, path) | {"@kind": "space"}),
            (BaseBuffer, self._buffer),
        ]

    def _tensor(self, value: Any, path: str) -> Node:
        if not isinstance(value, torch.Tensor):  # of JAX
            self.snapshot.tensors[path] = torch.from_numpy(np.array(value))
            return {"@kind": "jax", "name": path}
        self.snapshot.tensors[path] = value.detach()
        return {"@kind": "tensor", "name": path}

    def _array(self, value: np.ndarray, path: str, rows: Rows | None) -> Node:
        if value.dtype.hasobject:
            return {"@kind": "skip"}
        if rows is None or value.shape[:1] != (rows.capacity,):
            self.snapshot.arrays[path] = value
            return {"@kind": "array", "name": path}
        self.snapshot.arrays[path] = value[: rows.filled]
        return {"@kind": "rows", "name": path}

    def _container(self, value: dict | list | tuple | deque, path: str, rows: Rows | None) -> Node:
        if isinstance(value, dict):
            named = {
                str(key): self.describe(entry, f"{path}.{key}", rows)
                for key, entry in value.items()
            }
            return {"@kind": "dict", "entries": named}
        entries = [self.describe(entry, f"{path}.{i}", rows) for i, entry in enumerate(value)]
        return {
            "@kind": type(value).__name__ if not _is_named_tuple(value) else "named_tuple",
            "entries": entries,
        }

    def _module(self, module: torch.nn.Module, path: str) -> Node:
        names = []
        for name, tensor in module.state_dict().items():
            if isinstance(tensor, torch.Tensor):
                self._tensor(tensor, f"{path}.{name}")
                names.append(name)
        attributes = {}
        for name, part in module.named_modules():
            self.seen.add(id(part))
            for attribute, value in vars(part).items():
                if isinstance(value, _KEPT_IN_MODULES):
                    key = f"{name}.{attribute}".lstrip(".")
                    attributes[key] = self.describe(value, f"{path}.{key}")
        return {"@kind": "module", "path": path, "names": names, "attributes": attributes}

    def _optimizer(self, optimizer: torch.optim.Optimizer, path: str) -> Node:
        state = optimizer.state_dict()
        return {
            "@kind": "optimizer",
            "groups": self.describe(state["param_groups"], f"{path}.groups"),
            "state": self.describe(state["state"], f"{path}.state"),
        }

    def _scheduler(self, scheduler: LRScheduler, path: str) -> Node:
        return {"@kind": "scheduler", "state": self.describe(scheduler.state_dict(), path)}

    def _generator(self, generator: np.random.Generator, path: str) -> Node:
        return {"@kind": "generator", "state": generator.bit_generator.state}

    def _torch_generator(self, generator: torch.Generator, path: str) -> Node:
        return self._tensor(generator.get_state(), path) | {"@kind": "torch_generator"}

    def _buffer(self, buffer: BaseBuffer, path: str) -> Node:
        if isinstance(buffer, RolloutBuffer):  # refilled from the start in the next rollout
            return {"@kind": "skip"}
        if not self.with_buffers:
            return {"@kind": "skip"}
        filled = buffer.buffer_size if buffer.full else buffer.pos
        return self._object(buffer, path, Rows(filled, buffer.buffer_size))

    def _object(self, value: object, path: str, rows: Rows | None = None) -> Node:
        attributes = {
            name: self.describe(attribute, f"{path}.{name}", rows)
            for name, attribute in vars(value).items()
            if self.with_buffers or name not in _OF_EPISODES
        }
        kept = {name: node for name, node in attributes.items() if node != {"@kind": "skip"}}
        return {"@kind": "object", "attributes": kept}


class _Restore:
    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot

    def put(self, current: object, node: Node) -> Any:
        """Return what belongs in the place of ``current``, changed in place where possible."""
        if not isinstance(node, dict) or "@kind" not in node:
            return node
        kind = node["@kind"]
        if kind == "skip":
            return current
        return getattr(self, f"_put_{kind}")(current, node)

    def _put_tensor(self, current: object, node: Node) -> torch.Tensor:
        saved = self.snapshot.tensors[node["name"]]
        if isinstance(current, torch.Tensor):
            if current.shape == saved.shape:
                with torch.no_grad():
                    return current.copy_(saved)
            if current.requires_grad and current.is_leaf:  # an optimizer holds on to it
                raise ValueError(f"{node['name']} has shape {_shape(saved)}, not {_shape(current)}")
        return saved.clone()

    def _put_array(self, current: object, node: Node) -> np.ndarray:
        name = node["name"]
        shared = self.snapshot.tensors.get(name)  # by `compact`
        saved = self.snapshot.arrays[name] if shared is None else shared.numpy()
        if isinstance(current, np.ndarray) and current.flags.writeable:
            if (current.shape, current.dtype) == (saved.shape, saved.dtype):
                current[...] = saved
                return current
        return np.array(saved)

    def _put_rows(self, current: np.ndarray, node: Node) -> np.ndarray:
        """Fill the array in place: a replay buffer is too large to exist twice."""
        saved = self.snapshot.arrays[node["name"]]
        if current.shape[1:] != saved.shape[1:] or len(current) < len(saved):
            raise ValueError(f"{node['name']} has shape {_shape(saved)}, not {_shape(current)}")
        current[: len(saved)] = saved
        return current

    def _put_dict(self, current: object, node: Node) -> dict:
        kept = current if isinstance(current, dict) else {}
        known = {str(key): key for key in kept}
        kept |= {
            known.get(key, key): self.put(kept.get(known.get(key, key)), entry)
            for key, entry in node["entries"].items()
        }
        return kept

    def _put_list(self, current: object, node: Node) -> list:
        olds = list(current) if isinstance(current, list) else []
        olds += [None] * (len(node["entries"]) - len(olds))
        restored = [self.put(old, entry) for old, entry in zip(olds, node["entries"], strict=False)]
        if isinstance(current, list):
            current[:] = restored
            return current
        return restored

    def _put_tuple(self, current: tuple | None, node: Node) -> tuple:
        return tuple(self._put_list(list(current or ()), node))

    def _put_named_tuple(self, current: Any, node: Node) -> Any:
        if current is None:
            raise ValueError("a tuple with names has nothing to be put into")
        return type(current)(*self._put_list(list(current), node))

    def _put_jax(self, current: Any, node: Node) -> Any:
        import jax.numpy as jnp

        saved = self.snapshot.tensors[node["name"]]
        if current is not None and current.shape != saved.shape:
            raise ValueError(f"{node['name']} has shape {_shape(saved)}, not {_shape(current)}")
        return jnp.array(saved.numpy(), device=getattr(current, "device", None))

    def _put_deque(self, current: object, node: Node) -> deque:
        restored: deque = deque(maxlen=getattr(current, "maxlen", None))
        restored.extend(self.put(None, entry) for entry in node["entries"])
        return restored

    def _put_module(self, current: torch.nn.Module, node: Node) -> torch.nn.Module:
        same = node.get("same", {})  # target networks, by `compact`
        saved = {
            name: self.snapshot.tensors[f"{node['path']}.{same.get(name, name)}"]
            for name in node["names"]
        }
        current.load_state_dict(saved, strict=False)
        missing = set(current.state_dict()) - set(saved)
        if any(isinstance(current.state_dict()[name], torch.Tensor) for name in missing):
            raise KeyError(f"no saved values for {sorted(missing)}")
        for key, entry in node["attributes"].items():
            owner, _, attribute = key.rpartition(".")
            part = current.get_submodule(owner)
            setattr(part, attribute, self.put(getattr(part, attribute), entry))
        return current

    def _put_optimizer(self, current: torch.optim.Optimizer, node: Node) -> torch.optim.Optimizer:
        groups = self.put(None, node["groups"])
        state = self.put(None, node["state"])
        current.load_state_dict(
            {"param_groups": groups, "state": {int(index): entry for index, entry in state.items()}}
        )
        return current

    def _put_scheduler(self, current: LRScheduler, node: Node) -> LRScheduler:
        current.load_state_dict(self.put(None, node["state"]))
        return current

    def _put_generator(self, current: np.random.Generator, node: Node) -> np.random.Generator:
        current.bit_generator.state = node["state"]
        return current

    def _put_torch_generator(self, current: torch.Generator, node: Node) -> torch.Generator:
        current.set_state(self.snapshot.tensors[node["name"]])
        return current

    def _put_space(self, current: gym.Space, node: Node) -> gym.Space:
        current.np_random.bit_generator.state = node["state"]
        return current

    def _put_object(self, current: object, node: Node) -> object:
        attributes = vars(current)
        for name, entry in node["attributes"].items():
            if name in attributes:
                setattr(current, name, self.put(attributes[name], entry))
        return current


def _shape(value: np.ndarray | torch.Tensor) -> tuple[int, ...]:
    return tuple(value.shape)


def _is_jax_array(value: object) -> bool:
    """Tell without importing JAX, which is an optional package."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(value, jax.Array)


def _is_named_tuple(value: object) -> bool:
    return isinstance(value, tuple) and hasattr(value, "_fields")
