"""One description of every policy that can be exported: layers, normalization and action.

An observation's entries become numbers (`Entry`), which are joined in their order and normalized;
the layers follow, and the output is an action (`Output`). NumPy's files, the ONNX graph and the
contract are all written from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    unwrap_vec_normalize,
)
from torch import nn

from scilab_rl.canonical_spaces import CanonicalVecEnv, conversions
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.base import OneFileAlgorithm
from scilab_rl.learning.nn import GaussianNetwork

_ACTIVATIONS: dict[type[nn.Module], str] = {
    nn.ReLU: "relu",
    nn.Tanh: "tanh",
    nn.ELU: "elu",
    nn.LeakyReLU: "leaky_relu",
    nn.SiLU: "silu",
}
_UNDERSTOOD_LAYERS = (
    CanonicalVecEnv, ObservedVecEnv, VecNormalize, VecMonitor, VecCheckNan,
    VecTransposeImage,  # of images, which `_entry` refuses
)  # fmt: skip


@dataclass(frozen=True)
class Normalization:
    """Subtract the mean, divide by the scale, clip to the limit; in double precision."""

    mean: np.ndarray
    scale: np.ndarray
    limit: float


@dataclass(frozen=True)
class Entry:
    """One entry of the observation, as the environment gives it.

    Attributes:
        name: Its key; None where the observation is a single array.
        space: The environment's space.
        columns, values: For discrete entries: input i is whether number ``columns[i]`` equals
            ``values[i]``. Shapes: ``(n_inputs,)``.
        normalization: Of this entry.
    """

    name: str | None
    space: spaces.Space
    columns: np.ndarray | None = None
    values: np.ndarray | None = None
    normalization: Normalization | None = None

    @property
    def n_inputs(self) -> int:
        """How many inputs of the network it becomes."""
        return len(self.values) if self.values is not None else spaces.flatdim(self.space)


@dataclass(frozen=True)
class Layer:
    """A dense layer: ``activation(inputs @ weight + bias)``."""

    weight: np.ndarray
    bias: np.ndarray
    activation: str = "none"


@dataclass(frozen=True)
class Output:
    """From the last layer's numbers to the environment's action.

    Attributes:
        space: The environment's action space: ``Discrete``, whose action is the place of the
            largest number, counted from ``start``; or ``Box``, whose action is
            ``offset + scale * numbers``, clipped to the bounds.
    """

    space: spaces.Space
    scale: np.ndarray = field(default_factory=lambda: np.ones(0))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class PolicyDescription:
    """All that is needed to act as a policy does without exploration."""

    entries: Sequence[Entry]
    normalization: Normalization | None
    layers: Sequence[Layer]
    output: Output


@dataclass(frozen=True)
class _Network:
    """An algorithm's part of the description.

    Attributes:
        layers: Input first.
        is_scaled: Whether its numbers are actions in [-1, 1], not in the environment's bounds.
        gain: Share of the action range that is used.
        normalization: Of the joined inputs.
    """

    layers: Sequence[Layer]
    is_scaled: bool = True
    gain: float = 1.0
    normalization: Normalization | None = None


def describe(algorithm: Algorithm) -> PolicyDescription:
    """Describe the policy of an algorithm.

    Args:
        algorithm: With its saved weights and the environment that it acts in.

    Raises:
        ConfigError: If it cannot be described.
    """
    env = algorithm.get_env()
    entries = list(_entries(env))
    policy = getattr(algorithm, "policy", None)
    if isinstance(algorithm, OneFileAlgorithm):
        network = _one_file_network(algorithm)
    elif callable(getattr(policy, "obs_to_tensor", None)):
        network = _stable_baselines_network(policy)
    else:
        _refuse(f"{type(algorithm).__name__} is neither of ours nor of Stable-Baselines3's kind")
    output = _output(env, network)
    return PolicyDescription(entries, network.normalization, network.layers, output)


def _refuse(reason: str) -> NoReturn:
    raise ConfigError(f"This policy cannot be exported: {reason}.")


def _entries(env: VecEnv) -> Iterator[Entry]:
    """Yield the entries in the order in which the network reads them."""
    layer: VecEnv = env
    while isinstance(layer, VecEnvWrapper):
        if not isinstance(layer, _UNDERSTOOD_LAYERS):
            _refuse(f"the vector wrapper {type(layer).__name__} changes what it reads")
        layer = layer.venv
    space = conversions(env)[1].env_space
    normalization = unwrap_vec_normalize(env)
    if not isinstance(space, spaces.Dict):
        yield _entry(None, space, normalization)
        return
    for name in env.observation_space.spaces:  # type: ignore[attr-defined]
        yield _entry(name, space[name], normalization)


def _entry(name: str | None, space: spaces.Space, env: VecNormalize | None) -> Entry:
    if is_image_space(space):
        _refuse(f"{name or 'the observation'} is an image, and convolutions are not exported")
    if isinstance(space, spaces.Discrete):
        values = np.arange(space.n) + space.start
        return Entry(name, space, np.zeros(len(values), int), values)
    if isinstance(space, spaces.MultiDiscrete):
        sizes = space.nvec.ravel()
        ranges = [np.arange(n) + start for n, start in zip(sizes, space.start.ravel(), strict=True)]
        return Entry(name, space, np.repeat(np.arange(len(sizes)), sizes), np.concatenate(ranges))
    if not isinstance(space, (spaces.Box, spaces.MultiBinary)):
        _refuse(f"{name or 'the observation'} is {space}")
    return Entry(name, space, normalization=_normalization_of(name, env))


def _normalization_of(name: str | None, env: VecNormalize | None) -> Normalization | None:
    if env is None or not env.norm_obs:
        return None
    moments: Any = env.obs_rms
    if isinstance(moments, dict):
        if name not in moments:
            return None
        moments = moments[name]
    scale = np.sqrt(moments.var + env.epsilon)
    return Normalization(moments.mean.ravel(), scale.ravel(), float(env.clip_obs))


def _one_file_network(algorithm: OneFileAlgorithm) -> _Network:
    """Describe a one-file algorithm, also a changed copy, by the networks that it has."""
    own: Any = algorithm
    gain = float(getattr(own, "action_scale_factor", 1.0))
    if hasattr(own, "rounds"):
        return _compiled_network(own, gain)
    actor = getattr(getattr(own, "networks", own), "actor", None)
    if getattr(actor, "autocast", nullcontext) is not nullcontext:
        _refuse("it computes in bfloat16, and exported policies in float32")
    if isinstance(actor, GaussianNetwork):
        return _Network(_with_squashed_mean(_layers(actor.net), own.n_actions), gain=gain)
    found = getattr(own, "q_network", actor)
    if not isinstance(found, nn.Sequential):
        _refuse(f"{type(algorithm).__name__} has no network of dense layers that chooses actions")
    return _Network(_layers(found))


def _compiled_network(algorithm: Any, gain: float) -> _Network:
    """Describe the actor of an algorithm in JAX, which is an array of NumPy already."""
    params = algorithm.rounds.networks["actor"]
    if any("gain" in layer for layer in params):
        _refuse("its actor has layer normalization")
    layers = [Layer(p["weight"], p["bias"], "relu") for p in params[:-1]]
    layers.append(Layer(params[-1]["weight"], params[-1]["bias"]))
    # The last input, a relay's flag, is 0 for the task's own goal.
    n_inputs = spaces.flatdim(algorithm.observation_space)
    layers[0] = replace(layers[0], weight=layers[0].weight[:n_inputs])
    normalizer = algorithm.normalizer
    normalization = None
    if normalizer.active:
        normalization = Normalization(normalizer.mean, normalizer.scale, normalizer.limit)
    squashed = _with_squashed_mean(layers, algorithm.n_actions)
    return _Network(squashed, gain=gain, normalization=normalization)


def _with_squashed_mean(layers: Sequence[Layer], n_actions: int) -> list[Layer]:
    """Keep of the last layer what gives the mean, the first outputs, and squash it by tanh."""
    last = layers[-1]
    mean = Layer(last.weight[:, :n_actions], last.bias[:n_actions], "tanh")
    return [*layers[:-1], mean]


def _stable_baselines_network(policy: Any) -> _Network:
    if hasattr(policy, "lstm_actor"):
        _refuse("it is recurrent, and an exported policy has no memory")
    is_scaled = bool(getattr(policy, "squash_output", False))
    if hasattr(policy, "mlp_extractor"):  # PPO, A2C, TRPO
        _check_extractor(policy.pi_features_extractor)
        layers = _layers(policy.mlp_extractor.policy_net, policy.action_net)
        if is_scaled:  # with gSDE only
            layers = _with_squashed_mean(layers, len(layers[-1].bias))
    elif hasattr(policy, "quantile_net"):  # QRDQN
        _check_extractor(policy.quantile_net.features_extractor)
        network = policy.quantile_net
        layers = _mean_of_quantiles(_layers(network.quantile_net), network.n_quantiles)
    elif hasattr(policy, "q_net"):  # DQN
        _check_extractor(policy.q_net.features_extractor)
        layers = _layers(policy.q_net.q_net)
    elif hasattr(getattr(policy, "actor", None), "latent_pi"):  # SAC, TQC
        _check_extractor(policy.actor.features_extractor)
        layers = _layers(policy.actor.latent_pi, policy.actor.mu, nn.Tanh())
    elif hasattr(policy, "actor"):  # TD3, DDPG
        _check_extractor(policy.actor.features_extractor)
        layers = _layers(policy.actor.mu)
    else:
        _refuse(f"{type(policy).__name__} has no network that we know")
    return _Network(layers, is_scaled)


def _mean_of_quantiles(layers: Sequence[Layer], n_quantiles: int) -> list[Layer]:
    """Let the last layer give the mean of each action's quantiles."""
    weight, bias = layers[-1].weight, layers[-1].bias
    mean = Layer(
        weight.reshape(len(weight), n_quantiles, -1).mean(axis=1),
        bias.reshape(n_quantiles, -1).mean(axis=0),
    )
    return [*layers[:-1], mean]


def _check_extractor(extractor: nn.Module) -> None:
    """Reject what does more than to join an observation's entries."""
    parts = [extractor]
    if type(extractor) is CombinedExtractor:
        parts = list(extractor.extractors.values())
    for part in parts:
        if type(part) not in (FlattenExtractor, nn.Flatten):
            _refuse(f"its features extractor {type(part).__name__} is not exported")


def _layers(*parts: nn.Module) -> list[Layer]:
    """Return the dense layers of modules that follow each other."""
    layers: list[Layer] = []
    for module in _leaves(parts):
        name = _ACTIVATIONS.get(type(module))
        if isinstance(module, nn.Linear):
            layers.append(Layer(_array(module.weight).T, _array(module.bias)))
        elif name is None or not layers or _has_own_shape(module):
            _refuse(f"its layer {module} is not exported")
        elif layers[-1].activation != "none":
            _refuse("two activations follow each other")
        else:
            layers[-1] = replace(layers[-1], activation=name)
    if not layers:
        _refuse("it has no layers")
    return layers


def _leaves(modules: Sequence[nn.Module]) -> Iterator[nn.Module]:
    for module in modules:
        if isinstance(module, nn.Sequential):
            yield from _leaves(list(module))
        elif not isinstance(module, (nn.Identity, nn.Flatten, nn.Dropout)):
            yield module


def _has_own_shape(module: nn.Module) -> bool:
    """Return whether an activation has other constants than PyTorch's defaults."""
    return getattr(module, "alpha", 1.0) != 1.0 or getattr(module, "negative_slope", 0.01) != 0.01


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float32)


def _output(env: VecEnv, network: _Network) -> Output:
    """Describe how outputs become actions of the environment, in its own units."""
    conversion = conversions(env)[0]
    space, given = conversion.env_space, conversion.space
    n_outputs = len(network.layers[-1].bias)
    if isinstance(space, spaces.Discrete) and n_outputs == space.n:
        return Output(space)
    if not isinstance(space, spaces.Box) or space.dtype.kind != "f":
        _refuse(f"its actions are {space}; floating-point and Discrete ones are exported")
    assert isinstance(given, spaces.Box)
    scale, offset = np.ones(n_outputs), np.zeros(n_outputs)
    if network.is_scaled:
        scale, offset = _from_unit(given)
    if given is not space and space.dtype != np.float32:  # scaled once more, from [-1, 1]
        outer_scale, outer_offset = _from_unit(space)
        scale, offset = outer_scale * scale, outer_offset + outer_scale * offset
    return Output(space, network.gain * scale, offset)


def _from_unit(space: spaces.Box) -> tuple[np.ndarray, np.ndarray]:
    """Return scale and offset from [-1, 1] to the bounds."""
    low, high = space.low.ravel().astype(float), space.high.ravel().astype(float)
    return (high - low) / 2, (high + low) / 2
