"""Each intrinsic reward's equation against numbers computed by hand."""

import math

import pytest
import torch
from gymnasium import spaces
from torch import tensor

from scilab_rl.algorithms.intrinsic.critic_variance import CriticVariance
from scilab_rl.algorithms.intrinsic.disagreement import Disagreement, ensemble_variance
from scilab_rl.algorithms.intrinsic.icm import IntrinsicCuriosityModule, inverse_error
from scilab_rl.algorithms.intrinsic.morphological import MorphologicalComputation
from scilab_rl.algorithms.intrinsic.rnd import RandomNetworkDistillation
from scilab_rl.errors import ConfigError

from .conftest import PLAIN, agent_with, set_linear

STATES = tensor([[1.0, 2.0], [0.0, -1.0]])
ACTIONS = tensor([[0.5], [-1.0]])
NEXT_STATES = tensor([[2.0, 2.0], [1.0, 0.0]])


def test_critic_variance_is_the_mean_squared_deviation():
    def critic(observations, actions):  # two critics: the sum and three times the action
        return torch.cat([observations.sum(dim=1, keepdim=True), 3 * actions], dim=1)

    agent = agent_with(spaces.Box(-1.0, 1.0, (1,)), critic)
    intrinsic = CriticVariance(agent, normalize="none")
    # Q = (3, 1.5) and (-1, -3): deviations 0.75 and 1 from the mean.
    rewards = intrinsic.reward(STATES, ACTIONS, NEXT_STATES)
    torch.testing.assert_close(rewards, tensor([0.5625, 1.0]))


def test_critic_variance_needs_two_critics(agent):
    with pytest.raises(ConfigError, match="two critics"):
        CriticVariance(agent)


def test_rnd_is_the_squared_error_at_the_next_state(agent):
    intrinsic = RandomNetworkDistillation(agent, n_features=2, net_arch=[], **PLAIN)
    set_linear(intrinsic.target[0], [[1, 0], [0, 1]], [0, 0])
    set_linear(intrinsic.predictor[0], [[0, 0], [0, 2]], [1, 0])
    # f = s' = (2, 2), (1, 0); f^ = (1, 4), (1, 0): errors 1 + 4 and 0.
    torch.testing.assert_close(intrinsic.reward(STATES, ACTIONS, NEXT_STATES), tensor([5.0, 0.0]))
    assert intrinsic.loss(STATES, ACTIONS, NEXT_STATES).item() == pytest.approx(2.5)
    intrinsic.update(STATES, ACTIONS, NEXT_STATES)
    assert torch.equal(intrinsic.target[0].weight, torch.eye(2))


def test_icm_reward_and_loss(agent):
    icm = IntrinsicCuriosityModule(agent, n_features=2, net_arch=[], beta=0.2, **PLAIN)
    set_linear(icm.features[0], [[1, 0], [0, 1]], [0, 0])
    set_linear(icm.forward_model[0], [[1, 0, 2], [0, 1, 0]], [0, 0])
    set_linear(icm.inverse_model[0], [[-1, 0, 1, 0]], [0])
    # Forward: phi^ = s + (2 a, 0) = (2, 2), (-2, -1); phi = (2, 2), (1, 0): 1/2 (0), 1/2 (9 + 1).
    torch.testing.assert_close(icm.reward(STATES, ACTIONS, NEXT_STATES), tensor([0.0, 5.0]))
    # Inverse: a^ = s'_0 - s_0 = 1, 1 against 0.5, -1: (0.25 + 4) / 2.
    expected = 0.8 * 2.125 + 0.2 * 2.5
    assert icm.loss(STATES, ACTIONS, NEXT_STATES).item() == pytest.approx(expected)


def test_icm_guesses_discrete_actions_by_cross_entropy():
    logits, actions = tensor([[0.0, math.log(3.0)]]), tensor([[0.0, 1.0]])
    assert inverse_error(logits, actions, True).item() == pytest.approx(-math.log(0.75))


def test_disagreement_is_the_mean_squared_distance_from_the_mean():
    predictions = tensor([[[0.0, 0.0]], [[2.0, 0.0]], [[1.0, 3.0]]])
    # The mean is (1, 1): squared distances 1 + 1, 1 + 1 and 0 + 4.
    torch.testing.assert_close(ensemble_variance(predictions), tensor([8.0 / 3]))


def test_disagreement_of_two_linear_models(agent):
    intrinsic = Disagreement(agent, n_models=2, net_arch=[], **PLAIN)
    with torch.no_grad():
        intrinsic.models.weights[0].copy_(
            tensor([[[1, 0], [0, 1], [0, 0]], [[1, 0], [0, 1], [4, 0]]])
        )
        intrinsic.models.biases[0].zero_()
    # f_1 = s, f_2 = s + (4 a, 0): a distance of 2 a from the mean each.
    torch.testing.assert_close(intrinsic.reward(STATES, ACTIONS, NEXT_STATES), tensor([1.0, 4.0]))
    # Errors of f_1: (1, 0), (1, 1); of f_2: (-1, 0), (5, 1).
    expected = (1 + 2) / 2 + (1 + 26) / 2
    assert intrinsic.loss(STATES, ACTIONS, NEXT_STATES).item() == pytest.approx(expected)


def test_morphological_computation_is_the_divergence_of_two_normals(agent):
    intrinsic = MorphologicalComputation(agent, net_arch=[], **PLAIN)
    # p(s'|s, a) = N(s, 1), p(s'|a) = N((2 a, 0), 4), in two dimensions.
    identity = [[1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]]
    set_linear(intrinsic.models.state_action.net[0], identity, [0, 0, 0, 0])
    log_2 = math.log(2.0)
    set_linear(intrinsic.models.action.net[0], [[2], [0], [0], [0]], [0, 0, log_2, log_2])
    # KL per dimension: log 2 + (1 + d^2) / 8 - 1/2 with d = (0, 2) and (2, -1).
    expected = [2 * log_2 + (2 + 4) / 8 - 1, 2 * log_2 + (2 + 5) / 8 - 1]
    torch.testing.assert_close(intrinsic.reward(STATES, ACTIONS, NEXT_STATES), tensor(expected))
    # -log p: s' - s = (1, 0), (1, 1); s' - (2 a, 0) = (1, 2), (3, 0).
    informed = (1 + 2) / 4 + math.log(2 * math.pi)
    blind = (5 / 8 + 9 / 8) / 2 + 2 * log_2 + math.log(2 * math.pi)
    loss = intrinsic.loss(STATES, ACTIONS, NEXT_STATES).item()
    assert loss == pytest.approx(informed + blind)


@pytest.mark.parametrize(
    "cls",
    [Disagreement, IntrinsicCuriosityModule, MorphologicalComputation, RandomNetworkDistillation],
)
def test_what_is_familiar_surprises_less(agent, cls):
    torch.manual_seed(0)
    intrinsic = cls(agent, learning_rate=1e-2, net_arch=[16], **PLAIN)
    before = intrinsic.loss(STATES, ACTIONS, NEXT_STATES).item()
    for _ in range(100):
        intrinsic.update(STATES, ACTIONS, NEXT_STATES)
    assert intrinsic.loss(STATES, ACTIONS, NEXT_STATES).item() < before / 2
    assert intrinsic.n_updates == 100
