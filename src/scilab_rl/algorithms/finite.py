"""Refusing NaN and infinity before they spread."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from scilab_rl.errors import NumericalError


def check_finite(name: str, values: Any, update: int, **hyperparameters: Any) -> None:
    """Stop learning when a number is no longer one.

    Args:
        name: What it is, for example ``critic_loss``.
        values: One value per update, the last one belonging to ``update``.
        update: Number of gradient steps so far.
        **hyperparameters: Shown in the message.

    Raises:
        NumericalError: With what, at which update, with which hyperparameters.

    >>> check_finite("critic_loss", [0.1, 0.2], update=2, learning_rate=0.1)
    """
    array = torch.as_tensor(values).detach().flatten()
    # NaN and infinity survive a sum, which is one fast pass over the weights of a network.
    if torch.isfinite(array.sum()):
        return
    bad = torch.nonzero(~torch.isfinite(array)).flatten()
    if not len(bad):  # the sum overflowed, the values did not
        return
    first = int(bad[0])
    shown = ", ".join(f"{key}={value}" for key, value in hyperparameters.items())
    raise NumericalError(
        f"{name} is {array[first].item()} at update {update - len(array) + 1 + first} ({shown}). "
        "Often the learning rate is too high."
    )


def check_finite_weights(name: str, module: nn.Module, update: int, **shown: Any) -> None:
    """Stop learning when a weight is not finite, which a finite loss can hide for one update.

    Args:
        name: What the network is, for example ``actor``.
        module: The network.
        update: Number of gradient steps so far.
        **shown: Hyperparameters for the message.

    Raises:
        NumericalError: With the parameter, the update and the hyperparameters.
    """
    for parameter_name, parameter in module.named_parameters():
        total = parameter.detach().sum()
        if not torch.isfinite(total) and not torch.isfinite(parameter).all():
            check_finite(f"{name}.{parameter_name}", total, update, **shown)
