"""Shared parts of algorithms in JAX: layers, normalization, and rounds of compiled updates.

Nothing here knows what is learned. PyTorch stays where Stable-Baselines3 needs it: around the
environments and the replay buffer.
"""

from __future__ import annotations

import functools
import itertools
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch

from scilab_rl.errors import ConfigError
from scilab_rl.learning.finite import check_finite

Array = jax.Array | np.ndarray

Params = list[dict[str, Array]]  # one entry per layer, input first
State = dict[str, Any]

_log = logging.getLogger(__name__)


class Batch(NamedTuple):
    """Transitions as an update needs them.

    Shapes:
        observations, next_observations: ``(batch, n_observations)``; actions:
        ``(batch, n_actions)``; rewards, dones: ``(batch,)``; return_bounds: ``(2,)``, the lowest
        and the highest return that there can be; is_demo: ``(batch,)``, 1 where it is from a
        demonstration, None where nobody asks.
    """

    observations: Array
    actions: Array
    rewards: Array
    next_observations: Array
    dones: Array
    return_bounds: Array
    is_demo: Array | None = None


def dense_layers(sizes: Sequence[int], *, n: int | None = None, layer_norm: bool = False) -> Params:
    """Draw the weights of a network from NumPy's global generator.

    Args:
        sizes: Of input, hidden layers and output.
        n: Number of networks in one batched matrix product; None: one, without that dimension.
        layer_norm: Whether hidden layers are normalised (Ba et al., 2016, arXiv 1607.06450).

    Shapes:
        weights: ``([n,] n_in, n_out)``; biases: ``([n, 1,] n_out)``.
    """
    ensemble = () if n is None else (n,)
    rows = () if n is None else (n, 1)
    layers: Params = []
    for n_in, n_out in itertools.pairwise(sizes):
        bound = 1 / np.sqrt(n_in)  # the initialisation of torch.nn.Linear
        layer = {
            "weight": np.random.uniform(-bound, bound, (*ensemble, n_in, n_out)),
            "bias": np.random.uniform(-bound, bound, (*rows, n_out)),
        }
        if layer_norm and len(layers) < len(sizes) - 2:
            layer |= {"gain": np.ones((*rows, n_out)), "offset": np.zeros((*rows, n_out))}
        layers.append({name: values.astype(np.float32) for name, values in layer.items()})
    return layers


def forward(
    params: Params, inputs: Array, *, xp: ModuleType = jnp, precision: str = "float32"
) -> Array:
    """Return the output of a network with rectified linear units.

    Args:
        params: From `dense_layers`.
        inputs: Vectors.
        xp: ``jax.numpy``, or ``numpy`` to compute without JAX, which is faster for single vectors.
        precision: Of the matrix products.

    Shapes:
        inputs: ``(batch, n_in)``; result: ``([n,] batch, n_out)``.
    """
    hidden = inputs
    for layer in params[:-1]:
        hidden = _product(hidden, layer["weight"], xp, precision) + layer["bias"]
        if "gain" in layer:
            centred = hidden - hidden.mean(axis=-1, keepdims=True)
            deviation = xp.sqrt((centred * centred).mean(axis=-1, keepdims=True) + 1e-6)
            hidden = centred / deviation * layer["gain"] + layer["offset"]
        hidden = xp.maximum(hidden, 0.0)
    return _product(hidden, params[-1]["weight"], xp, precision) + params[-1]["bias"]


def _product(inputs: Array, weight: Array, xp: ModuleType, precision: str) -> Array:
    if precision == "float32" or xp is np:
        return xp.matmul(inputs, weight)
    narrow = jnp.dtype(precision)
    return jnp.matmul(
        inputs.astype(narrow), weight.astype(narrow), preferred_element_type=jnp.float32
    )


class Normalizer:
    """Running mean and deviation of each dimension of the observations (Chan et al., 1979).

    Args:
        n_observations: Length of an observation.
        active: If not, observations stay as they are.
        n_flags: So many numbers at its end stay as they are.
    """

    limit = 5.0

    def __init__(self, n_observations: int, *, active: bool, n_flags: int = 0) -> None:
        self.active = active
        self.count = 0
        self.n_normalized = n_observations - n_flags
        self.mean = np.zeros(self.n_normalized)
        self.squares = np.zeros(self.n_normalized)  # sum of squared deviations from the mean

    @property
    def scale(self) -> np.ndarray:
        """What deviations are divided by: at least 0.01, so that constant dimensions stay small."""
        return np.maximum(np.sqrt(self.squares / max(self.count, 1)), 1e-2)

    def update(self, vectors: np.ndarray) -> None:
        """Take observations into account. Shapes: ``(batch, n_observations)``."""
        if not self.active:
            return
        n, vectors = len(vectors), vectors[:, : self.n_normalized]
        difference = vectors.mean(axis=0) - self.mean
        total = self.count + n
        self.squares += ((vectors - vectors.mean(axis=0)) ** 2).sum(axis=0)
        self.squares += difference**2 * (self.count * n / total)
        self.mean += difference * (n / total)
        self.count = total

    def __call__(self, vectors: np.ndarray) -> np.ndarray:
        """Return observations in deviations from the mean, clipped to 5.

        Shapes:
            vectors, result: ``(..., n_observations)``.
        """
        if not self.active:
            return vectors
        values, flags = np.split(vectors, [self.n_normalized], axis=-1)
        normal = (values - self.mean) / self.scale
        normal = normal.clip(-self.limit, self.limit).astype(np.float32)
        return np.concatenate([normal, flags], axis=-1) if flags.shape[-1] else normal


class UpdateRunner:
    """Runner of updates, which are computed while the caller continues.

    Between `start` and `finish` a round may be under way; ``networks`` are those of the round
    before. What a round computes does not depend on how long it takes, and a checkpoint may be
    taken at any time: it waits for the round.

    Args:
        update: ``(state, batch, key, index) -> (state, losses)``: one gradient step, pure. The key
            is of its random numbers, the index the number of updates before it.
        state: What it changes: weights, moments, temperatures.
        shown: Names of the entries of ``state`` that are needed to act.
        device: ``auto``, ``cpu`` or ``cuda``.

    Attributes:
        state: Arrays of JAX, perhaps still being computed.
        networks: The shown entries as arrays of NumPy, after the last finished round.
        n_started: Number of updates that were started.
    """

    def __init__(
        self,
        update: Callable[[State, Batch, Array, Array], tuple[State, dict[str, Array]]],
        state: State,
        shown: Sequence[str],
        device: str,
    ) -> None:
        self._device = prepare_jax(device)
        self.state = jax.device_put(jax.tree.map(jnp.array, state), self._device)
        self.shown = list(shown)
        self.networks = self._copy_networks()
        self.seed = int(np.random.randint(2**31))
        self.n_started = 0
        self._losses: dict[str, Array] = {}
        self._compute = jax.jit(functools.partial(_scan, update), donate_argnums=0)

    def start(self, batch: Batch) -> None:
        """Start a round; the previous one must be finished.

        Args:
            batch: One update's transitions per entry. Shapes: ``(n_updates, batch, ...)``.
        """
        seed, first = np.uint32(self.seed), np.uint32(self.n_started)
        self.state, self._losses = self._compute(self.state, batch, seed, first)
        self.n_started += len(batch.rewards)

    def finish(self, **shown: object) -> dict[str, torch.Tensor]:
        """Wait for the round under way, let its networks act, and return its losses.

        Args:
            **shown: Hyperparameters, for the message.

        Returns:
            Name to one value per update; empty when there was no round.

        Raises:
            NumericalError: If a loss or a weight is not finite.
        """
        if not self._losses:
            return {}
        losses = {name: torch.from_numpy(np.array(v)) for name, v in self._losses.items()}
        self._losses = {}
        for name, values in losses.items():
            check_finite(name, values, self.n_started, **shown)
        self.networks = self._copy_networks()
        for name, network in self.networks.items():
            total = sum(values.sum() for layer in network for values in layer.values())
            check_finite(f"a weight of the {name}", [float(total)], self.n_started, **shown)
        return losses

    def _copy_networks(self) -> dict[str, Params]:
        # Real copies: the buffers of the state are reused by the next round.
        return jax.tree.map(np.array, {name: self.state[name] for name in self.shown})


def _scan(
    update: Callable[..., tuple[State, dict[str, Array]]],
    state: State,
    batches: Batch,
    seed: Array,
    first: Array,
) -> tuple[State, dict[str, Array]]:
    """Do one update per entry of the batches, one after the other."""
    key = jax.random.key(seed)

    def one(state: State, item: tuple[Array, Batch]) -> tuple[State, dict[str, Array]]:
        index, batch = item
        return update(state, batch, jax.random.fold_in(key, index), index)

    indices = first + jnp.arange(len(batches.rewards), dtype=jnp.uint32)
    return jax.lax.scan(one, state, (indices, batches))


@functools.cache
def prepare_jax(device: str) -> jax.Device:
    """Choose the device, and keep compiled programs so that a second start compiles nothing.

    Args:
        device: ``auto`` (a GPU if JAX has one), ``cpu`` or ``cuda``.

    Raises:
        ConfigError: If JAX has no such device.
    """
    # A run takes the memory that it needs, so that several share a GPU, also with PyTorch.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "scilab-rl" / "jax"
    try:
        cache.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        _log.warning("Compiled programs are not kept: %s.", error)
    else:
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    given = os.environ.get("NPROC")
    if torch.get_num_threads() == 1:  # n_threads=1
        os.environ["NPROC"] = "1"  # the size of XLA's thread pool, read when it is made
    try:
        return jax.devices(None if device == "auto" else device)[0]
    except RuntimeError as error:
        raise ConfigError(
            f"JAX has no device '{device}' here, only {jax.default_backend()}; use device=auto."
        ) from error
    finally:
        if given is None:
            os.environ.pop("NPROC", None)
        else:
            os.environ["NPROC"] = given


def return_bounds(rewards: np.ndarray, gamma: float, bounds: np.ndarray) -> np.ndarray:
    """Return what discounted returns can be, given all rewards that were ever seen.

    An episode may end after any number of steps, so the return lies between the least and the
    greatest of r and r / (1 - gamma).

    Args:
        rewards: New ones.
        gamma: Discount factor.
        bounds: Lowest and highest reward so far; changed in place.

    >>> return_bounds(np.array([-1.0, 0.0]), 0.98, np.array([np.inf, -np.inf])).round(6).tolist()
    [-50.0, 0.0]
    """
    bounds[0] = min(bounds[0], rewards.min())
    bounds[1] = max(bounds[1], rewards.max())
    horizon = 1 / (1 - gamma) if gamma < 1 else np.inf
    low, high = bounds
    return np.array([min(low, low * horizon), max(high, high * horizon)], dtype=np.float32)


def split_into_updates(n_updates: int, **fields: np.ndarray) -> Batch:
    """Split transitions into one batch per update. Shapes: ``(n_updates, batch, ...)``."""
    return Batch(
        **{
            name: values.reshape(n_updates, -1, *values.shape[1:])
            for name, values in fields.items()
        }
    )
