"""Networks in PyTorch, a gradient step, target updates, and how much critics disagree."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

PRECISIONS = ("float32", "bfloat16")
Autocast = Callable[[], AbstractContextManager[object]]


def network(sizes: Sequence[int], activation: Callable[[], nn.Module] = nn.ReLU) -> nn.Sequential:
    """Return linear layers with an activation between them.

    Args:
        sizes: Length of the input, of each hidden layer and of the output.
        activation: Makes the module between two layers.
    """
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), activation()]
    return nn.Sequential(*layers[:-1])


class GaussianNetwork(nn.Module):
    """A network that gives a normal distribution with independent dimensions.

    Args:
        sizes: Length of the input, of each hidden layer and of the output.
        log_std_range: Limits of the logarithm of the standard deviation.
        autocast: Opens a context for the matrix products, see `autocast_to`.

    Shapes:
        inputs: ``(batch, sizes[0])``; mean, log_std: ``(batch, sizes[-1])``.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        log_std_range: tuple[float, float],
        autocast: Autocast = nullcontext,
    ) -> None:
        super().__init__()
        self.net = network([*sizes[:-1], 2 * sizes[-1]])
        self.log_std_range = log_std_range
        self.autocast = autocast

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the standard deviation."""
        with self.autocast():
            parameters = self.net(inputs)
        mean, log_std = parameters.float().chunk(2, dim=-1)
        return mean, log_std.clamp(*self.log_std_range)


class Ensemble(nn.Module):
    """Several networks with the same input, all in one batched matrix product.

    Args:
        sizes: Length of the input, of each hidden layer and of the output.
        n_networks: How many networks.
        autocast: Opens a context for the matrix products, see `autocast_to`.

    Shapes:
        inputs: ``(batch, ...)`` each, joined to ``(batch, sizes[0])``;
        result: ``(n_networks, batch, sizes[-1])``; weights: ``(n_networks, n_in, n_out)``.
    """

    def __init__(
        self, sizes: Sequence[int], n_networks: int, autocast: Autocast = nullcontext
    ) -> None:
        super().__init__()
        self.autocast = autocast
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for n_in, n_out in itertools.pairwise(sizes):
            bound = 1 / math.sqrt(n_in)  # the initialization of torch.nn.Linear
            self.weights.append(torch.empty(n_networks, n_in, n_out).uniform_(-bound, bound))
            self.biases.append(torch.empty(n_networks, 1, n_out).uniform_(-bound, bound))

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the output of each network."""
        joined = torch.cat(inputs, dim=1)
        hidden = joined.expand(len(self.weights[0]), *joined.shape)
        *hidden_layers, (last_weight, last_bias) = zip(self.weights, self.biases, strict=True)
        with self.autocast():
            for weight, bias in hidden_layers:
                hidden = F.relu_(torch.baddbmm(bias, hidden, weight))
        if last_weight.shape[2] > 1:
            return torch.baddbmm(last_bias, hidden.float(), last_weight)
        # For one output, a sum is faster than a matrix product of one column.
        return (hidden * last_weight.mT).sum(dim=-1, keepdim=True) + last_bias


class Critics(Ensemble):
    """``n_critics`` independent action-value functions.

    Args:
        n_observations: Length of an observation.
        n_actions: Dimensions of an action.
        net_arch: Sizes of the hidden layers.
        n_critics: How many.
        autocast: Opens a context for the matrix products, see `autocast_to`.

    Shapes:
        observations: ``(batch, n_observations)``; actions: ``(batch, n_actions)``;
        result: ``(batch, n_critics)``.
    """

    def __init__(
        self,
        n_observations: int,
        n_actions: int,
        net_arch: Sequence[int],
        n_critics: int,
        autocast: Autocast = nullcontext,
    ) -> None:
        super().__init__([n_observations + n_actions, *net_arch, 1], n_critics, autocast)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the value that each critic gives to each pair of observation and action."""
        return super().forward(*inputs).squeeze(-1).T


def critic_variance(q_values: Tensor) -> Tensor:
    """Return how much the critics disagree: the mean squared deviation from their mean.

    Shapes:
        q_values: ``(batch, n_critics)``; result: ``(batch, 1)``.
    """
    return q_values.var(dim=1, correction=0, keepdim=True)


def gradient_step(
    optimizer: torch.optim.Optimizer, loss: Tensor, max_grad_norm: float | None = None
) -> Tensor:
    """Take one step down the gradient, of the optimizer's own parameters only; return the loss.

    Args:
        optimizer: Of the parameters that learn.
        loss: Scalar.
        max_grad_norm: Largest norm of the gradient; None: any.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    optimizer.zero_grad()
    loss.backward(inputs=parameters)
    if max_grad_norm is not None:
        nn.utils.clip_grad_norm_(parameters, max_grad_norm)
    optimizer.step()
    return loss.detach()


@torch.no_grad()
def update_target(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move a target network a fraction tau towards the learned one."""
    for slow, fast in zip(target.parameters(), source.parameters(), strict=True):
        slow.lerp_(fast, tau)


def checked_precision(precision: str) -> str:
    """Return a precision of matrix products.

    Raises:
        ValueError: If there is no such precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be {' or '.join(PRECISIONS)}, but it is {precision!r}")
    return precision


def autocast_to(precision: str, device: torch.device) -> Autocast:
    """Return what opens a context whose matrix products have this precision.

    Weights, gradients of weights, losses and everything outside of the context stay float32.
    """
    if checked_precision(precision) == "float32":
        return nullcontext
    return partial(torch.autocast, device.type, torch.bfloat16)
