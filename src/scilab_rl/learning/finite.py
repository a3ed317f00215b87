"""Refusing NaN and infinity before they spread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from scilab_rl.errors import NumericalError


def check_finite(
    name: str, values: Tensor | Sequence[float], update: int, **hyperparameters: object
) -> None:
    """Stop learning when a number is not finite any more.

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
    bad = torch.nonzero(~torch.isfinite(array)).flatten().tolist()
    if bad:
        _refuse(name, array[bad[0]].item(), update - len(array) + 1 + bad[0], hyperparameters)


def check_finite_weights(name: str, module: nn.Module, update: int, **shown: object) -> None:
    """Stop learning when a weight is not finite, which a finite loss can hide for one update.

    Args:
        name: What the network is, for example ``actor``.
        module: The network.
        update: Number of gradient steps so far.
        **shown: Hyperparameters for the message.

    Raises:
        NumericalError: With the parameter, the update and the hyperparameters.
    """
    # NaN and infinity survive a sum: one fast pass tells for the whole network. Which weight it is,
    # and whether only the sum overflowed, is asked afterwards.
    with torch.no_grad():
        total = torch.stack([parameter.sum() for parameter in module.parameters()]).sum()
        if torch.isfinite(total):
            return
        for parameter_name, parameter in module.named_parameters():
            bad = parameter[~torch.isfinite(parameter)]
            if len(bad):
                _refuse(f"{name}.{parameter_name}", bad[0].item(), update, shown)


def _refuse(name: str, value: float, update: int, hyperparameters: Mapping[str, object]) -> None:
    shown = ", ".join(f"{key}={entry}" for key, entry in hyperparameters.items())
    raise NumericalError(
        f"{name} is {value} at update {update} ({shown}). Often the learning rate is too high."
    )
