"""Observations of all kinds, as one vector each and in batches."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from scilab_rl.envs.types import Observation

Tensors: TypeAlias = torch.Tensor | dict[str, torch.Tensor]  # as networks read them


def to_vector(
    values: Observation | Tensors, space: spaces.Space, device: torch.device
) -> torch.Tensor:
    """Turn a batch of observations of any kind into one vector each.

    The entries of a dictionary are joined, discrete ones, counted from 0, become one-hot vectors,
    and images are scaled to [0, 1]: what has three dimensions of bytes from 0 to 255.

    Shapes:
        values: ``(batch, ...)`` per entry; result: ``(batch, flatdim(space))``.
    """
    if isinstance(space, spaces.Dict):
        assert isinstance(values, dict)
        entries = [to_vector(values[key], entry, device) for key, entry in space.spaces.items()]
        return torch.cat(entries, dim=1)
    tensor = torch.as_tensor(values, device=device)
    if isinstance(space, spaces.Discrete):
        return F.one_hot(tensor.long().flatten(), int(space.n)).float()
    if isinstance(space, spaces.MultiDiscrete):
        columns = tensor.long().unbind(dim=1)
        sizes = space.nvec.tolist()
        parts = [F.one_hot(column, size) for column, size in zip(columns, sizes, strict=True)]
        return torch.cat(parts, dim=1).float()
    vector = tensor.reshape(len(tensor), -1).float()
    return vector / 255.0 if is_image_space(space) else vector


def state_columns(space: spaces.Space) -> list[int]:
    """Return where in an observation's vector the state is: everywhere but at the desired goal."""
    if not isinstance(space, spaces.Dict):
        return list(range(spaces.flatdim(space)))
    columns: list[int] = []
    start = 0
    for key, entry in space.spaces.items():
        stop = start + spaces.flatdim(entry)
        columns += [] if key == "desired_goal" else range(start, stop)
        start = stop
    return columns


def batch_of_one(observation: Observation) -> Observation:
    """Give a single observation a batch dimension."""
    if isinstance(observation, dict):
        return {key: np.asarray(entry)[np.newaxis] for key, entry in observation.items()}
    return np.asarray(observation)[np.newaxis]


def single(observations: Observation, index: int) -> Observation:
    """Return a copy of one environment's observation, without a batch dimension."""
    if isinstance(observations, dict):
        return {key: np.array(entry[index]) for key, entry in observations.items()}
    return np.array(observations[index])
