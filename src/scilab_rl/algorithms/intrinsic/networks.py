"""The networks of learned intrinsic rewards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def network(sizes: Sequence[int]) -> nn.Sequential:
    """Return linear layers of these sizes with ReLU between them.

    Args:
        sizes: Length of the input, of each hidden layer and of the output.
    """
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Ensemble(nn.Module):
    """Several networks with the same input, all in one batched matrix product.

    Args:
        sizes: Length of the input, of each hidden layer and of the output.
        n_models: How many networks.

    Shapes:
        inputs: ``(batch, n_inputs)``; result: ``(n_models, batch, n_outputs)``.
    """

    def __init__(self, sizes: Sequence[int], n_models: int) -> None:
        super().__init__()
        self.n_models = n_models
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for n_in, n_out in itertools.pairwise(sizes):
            bound = 1 / math.sqrt(n_in)  # the initialisation of torch.nn.Linear
            self.weights.append(torch.empty(n_models, n_in, n_out).uniform_(-bound, bound))
            self.biases.append(torch.empty(n_models, 1, n_out).uniform_(-bound, bound))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the output of each network."""
        hidden = inputs.expand(self.n_models, *inputs.shape)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = F.relu(torch.baddbmm(bias, hidden, weight))
        return torch.baddbmm(self.biases[-1], hidden, self.weights[-1])
