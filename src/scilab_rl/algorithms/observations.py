"""Observations of all kinds: as one vector each, in batches, and at the end of an episode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from gymnasium import spaces

Observation = np.ndarray | dict[str, np.ndarray]


def to_vector(values: Any, space: spaces.Space, device: torch.device) -> torch.Tensor:
    """Turn a batch of observations of any kind into one vector each.

    The entries of a dictionary are joined, discrete ones become one-hot vectors, and the bytes of
    images are scaled to [0, 1].

    Shapes:
        values: ``(batch, ...)`` per entry; result: ``(batch, flatdim(space))``.
    """
    if isinstance(space, spaces.Dict):
        entries = [to_vector(values[key], entry, device) for key, entry in space.spaces.items()]
        return torch.cat(entries, dim=1)
    tensor = torch.as_tensor(values, device=device)
    if isinstance(space, spaces.Discrete):
        return F.one_hot(tensor.long().flatten() - int(space.start), int(space.n)).float()
    if isinstance(space, spaces.MultiDiscrete):
        columns = tensor.long().reshape(len(tensor), -1).unbind(dim=1)
        sizes = space.nvec.flatten().tolist()
        parts = [F.one_hot(column, size) for column, size in zip(columns, sizes, strict=True)]
        return torch.cat(parts, dim=1).float()
    vector = tensor.reshape(len(tensor), -1).float()
    return vector / 255.0 if space.dtype == np.uint8 else vector


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


def with_terminal_observations(
    new_obs: Observation,
    dones: np.ndarray,
    infos: list[dict[str, Any]],
    convert: Callable[[Any], Any],
) -> Observation:
    """Put the last observation of an ended episode in the place of the next episode's first."""
    ended = np.flatnonzero(dones)
    if not len(ended):
        return new_obs
    copies = (
        {k: v.copy() for k, v in new_obs.items()} if isinstance(new_obs, dict) else new_obs.copy()
    )
    for index in ended:
        last = convert(infos[index]["terminal_observation"])
        if isinstance(copies, dict):
            for key in copies:
                copies[key][index] = last[key]
        else:
            copies[index] = last
    return copies
