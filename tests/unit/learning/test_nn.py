from __future__ import annotations

import pytest
import torch

from scilab_rl.learning.nn import (
    Critics,
    Ensemble,
    checked_precision,
    critic_variance,
    gradient_step,
    network,
    update_target,
)


def test_variance_of_the_critics_is_the_mean_squared_deviation() -> None:
    variance = critic_variance(torch.tensor([[1.0, 3.0], [2.0, 2.0]]))
    assert variance.flatten().tolist() == [1.0, 0.0]
    assert critic_variance(torch.tensor([[5.0]])).tolist() == [[0.0]]  # one critic


def test_batched_critics_equal_separate_networks() -> None:
    torch.manual_seed(0)
    critics = Critics(n_observations=3, n_actions=2, net_arch=[5, 4], n_critics=3)
    observations, actions = torch.randn(7, 3), torch.randn(7, 2)
    together = critics(observations, actions)
    assert together.shape == (7, 3)
    for index in range(3):
        hidden = torch.cat([observations, actions], dim=1)
        for layer, (weight, bias) in enumerate(zip(critics.weights, critics.biases, strict=True)):
            hidden = hidden @ weight[index] + bias[index]
            hidden = hidden.relu() if layer < 2 else hidden
        torch.testing.assert_close(together[:, index], hidden.squeeze(1))
    assert not torch.equal(together[:, 0], together[:, 1])


def test_an_ensemble_has_several_outputs_and_joins_its_inputs() -> None:
    torch.manual_seed(0)
    ensemble = Ensemble([3, 4, 2], n_networks=2)
    inputs = torch.randn(5, 3)
    together = ensemble(inputs[:, :1], inputs[:, 1:])
    assert together.shape == (2, 5, 2)
    first, last = (weights[1] for weights in ensemble.weights)
    hidden = (inputs @ first + ensemble.biases[0][1]).relu()
    torch.testing.assert_close(together[1], hidden @ last + ensemble.biases[1][1])


def test_a_network_has_an_activation_between_its_layers() -> None:
    layers = network([3, 4, 2], torch.nn.Tanh)
    assert [type(layer).__name__ for layer in layers] == ["Linear", "Tanh", "Linear"]
    assert layers[0].weight.shape == (4, 3)
    assert layers[2].weight.shape == (2, 4)


def test_targets_follow_by_tau() -> None:
    target, source = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    torch.nn.init.constant_(target.weight, 1.0)
    torch.nn.init.constant_(source.weight, 3.0)
    update_target(target, source, tau=0.25)
    assert target.weight.item() == 1.5


def test_a_gradient_step_may_be_limited() -> None:
    # L = 3 w + 4 v: the gradient has the norm 5, and is scaled down to 1.
    w, v = (torch.zeros(1, requires_grad=True) for _ in range(2))
    optimizer = torch.optim.SGD([w, v], lr=1.0)
    assert gradient_step(optimizer, (3 * w + 4 * v).sum(), max_grad_norm=1.0).item() == 0.0
    assert [w.item(), v.item()] == pytest.approx([-0.6, -0.8], abs=1e-5)
    gradient_step(optimizer, (3 * w).sum())
    assert w.item() == pytest.approx(-3.6, abs=1e-5)


def test_other_precisions_are_refused() -> None:
    assert checked_precision("bfloat16") == "bfloat16"
    with pytest.raises(
        ValueError, match="precision must be float32 or bfloat16, but it is 'float8'"
    ):
        checked_precision("float8")
