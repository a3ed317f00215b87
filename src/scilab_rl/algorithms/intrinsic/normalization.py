"""Bringing intrinsic rewards and observations to a common scale."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor


class RunningMoments:
    """Mean and variance of everything seen so far, per dimension.

    Batches are merged as in Chan, Golub and LeVeque, 1979, "Updating formulae and a pairwise
    algorithm for computing sample variances".

    Args:
        shape: Shape of one value.
        device: Where the moments live.

    Attributes:
        count: Values so far.
        mean: Their mean.
        variance: Their mean squared deviation from the mean.
    """

    def __init__(self, shape: Sequence[int], device: torch.device) -> None:
        self.count = 0
        self.mean = torch.zeros(tuple(shape), device=device)
        self.variance = torch.ones(tuple(shape), device=device)

    def update(self, values: Tensor) -> None:
        """Add a batch. Shapes: ``(batch, *shape)``."""
        n = len(values)
        total = self.count + n
        mean, variance = values.mean(dim=0), values.var(dim=0, correction=0)
        delta = mean - self.mean
        squares = self.count * self.variance + n * variance
        self.variance = (squares + delta.square() * self.count * n / total) / total
        self.mean = self.mean + delta * n / total
        self.count = total

    @property
    def scale(self) -> Tensor:
        """The standard deviation; 1 where all values were equal."""
        std = self.variance.sqrt()
        return torch.where(std > 0, std, torch.ones_like(std))


class Normalization(ABC):
    """Scales intrinsic rewards.

    Args:
        device: Where its numbers live.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    @abstractmethod
    def update(self, rewards: Tensor) -> None:
        """Learn from a batch. Shapes: ``(batch,)``."""

    @abstractmethod
    def apply(self, rewards: Tensor) -> Tensor:
        """Scale rewards by what was learned. Shapes: ``(batch,)``."""


class RunningStd(Normalization):
    """Divides by the standard deviation of all rewards so far (Burda et al., 2018, section 2.4)."""

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self.moments = RunningMoments((), device)

    def update(self, rewards: Tensor) -> None:
        """Add a batch to the moments."""
        self.moments.update(rewards)

    def apply(self, rewards: Tensor) -> Tensor:
        """Divide by the standard deviation."""
        return rewards / self.moments.scale


class MinMax(Normalization):
    """Scales the last batch to [0, 1], as the Scilab-RL paper does; equal rewards become 0."""

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self.low = torch.zeros((), device=device)
        self.high = torch.ones((), device=device)

    def update(self, rewards: Tensor) -> None:
        """Keep the smallest and the largest reward of the batch."""
        self.low, self.high = rewards.min(), rewards.max()

    def apply(self, rewards: Tensor) -> Tensor:
        """Scale so that the last batch lies in [0, 1]."""
        tiny = torch.finfo(rewards.dtype).tiny
        return (rewards - self.low) / (self.high - self.low).clamp(min=tiny)


class Unscaled(Normalization):
    """Leaves rewards as they are."""

    def update(self, rewards: Tensor) -> None:
        """Nothing to learn."""

    def apply(self, rewards: Tensor) -> Tensor:
        """Return the rewards themselves."""
        return rewards


NORMALIZATIONS: dict[str, type[Normalization]] = {
    "running_std": RunningStd,
    "min_max": MinMax,
    "none": Unscaled,
}
