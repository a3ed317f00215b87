"""How an intrinsic reward is scaled and joined to the task's, and what an algorithm sees of it."""

import math
from collections import namedtuple

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import tensor

from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.algorithms.intrinsic.normalization import MinMax, RunningMoments, RunningStd
from scilab_rl.errors import NumericalError
from scilab_rl.metrics.logger import as_number

from .conftest import PLAIN, agent_with

CPU = torch.device("cpu")


class FirstEntry(IntrinsicReward):
    """Rewarded with the first entry of the state, and learns nothing."""

    def reward(self, observations, actions, next_observations):
        return self.vectors(observations, actions, next_observations)[0][:, 0]


def transitions(*first_entries):
    states = torch.zeros(len(first_entries), 2)
    states[:, 0] = tensor(first_entries)
    return states, torch.zeros(len(first_entries), 1), states


def test_running_moments_equal_those_of_all_values_at_once():
    values = np.random.default_rng(3).normal(2.0, 3.0, (50, 4))
    moments = RunningMoments((4,), CPU)
    for part in (values[:1], values[1:20], values[20:]):
        moments.update(torch.as_tensor(part))
    assert moments.count == 50
    np.testing.assert_allclose(moments.mean, values.mean(axis=0))
    np.testing.assert_allclose(moments.variance, values.var(axis=0))


def test_running_std_divides_by_the_deviation_of_all_batches():
    scaling = RunningStd(CPU)
    scaling.update(tensor([1.0, 3.0]))
    scaling.update(tensor([5.0, 7.0]))
    # The mean is 4, the variance (9 + 1 + 1 + 9) / 4.
    torch.testing.assert_close(scaling.apply(tensor([10.0])), tensor([10 / math.sqrt(5)]))


def test_equal_rewards_divide_by_nothing():
    for scaling, expected in ((RunningStd(CPU), 2.0), (MinMax(CPU), 0.0)):
        scaling.update(tensor([2.0, 2.0]))
        assert scaling.apply(tensor([2.0, 2.0])).tolist() == [expected, expected]


def test_min_max_scales_each_batch():
    scaling = MinMax(CPU)
    scaling.update(tensor([-100.0, 100.0]))
    scaling.update(tensor([1.0, 3.0, 5.0]))
    assert scaling.apply(tensor([1.0, 3.0, 5.0])).tolist() == [0.0, 0.5, 1.0]


def test_mix_is_the_weighted_mean_of_both_rewards(agent):
    intrinsic = FirstEntry(agent, weight=0.25, **PLAIN)
    mixed = intrinsic.mix(tensor([[-1.0], [0.0]]), *transitions(2.0, 6.0))
    assert mixed.tolist() == [[0.75 * -1 + 0.25 * 2], [0.25 * 6]]
    recorded = agent.algorithm.logger.name_to_value
    assert as_number(recorded["train/intrinsic_reward"]) == 4.0


def test_reward_is_computed_before_the_models_learn(agent):
    class Counting(FirstEntry):
        def reward(self, *batch):
            assert self.n_updates == 0
            return super().reward(*batch)

        def loss(self, states, actions, next_states):
            return (self.offset + states[:, 0]).square().mean()

    intrinsic = Counting(agent, weight=1.0, **PLAIN)
    intrinsic.offset = torch.zeros((), requires_grad=True)
    intrinsic.optimizer = torch.optim.SGD([intrinsic.offset], lr=0.5)
    assert intrinsic.mix(torch.zeros(2), *transitions(1.0, 3.0)).tolist() == [1.0, 3.0]
    # The gradient is twice the mean, 4: one step of 0.5 down.
    assert intrinsic.offset.item() == pytest.approx(-2.0)
    assert intrinsic.n_updates == 1


def test_long_rollouts_are_learned_in_minibatches(agent):
    seen = []

    class Noting(FirstEntry):
        def loss(self, states, actions, next_states):
            seen.append(sorted(states[:, 0].tolist()))
            return self.offset * 0.0

    intrinsic = Noting(agent, **PLAIN)
    intrinsic.offset = torch.zeros((), requires_grad=True)
    intrinsic.optimizer = torch.optim.SGD([intrinsic.offset], lr=0.1)
    intrinsic.update(*transitions(1.0, 2.0, 3.0, 4.0, 5.0), batch_size=2)
    assert [len(batch) for batch in seen] == [2, 2, 1]
    assert sorted(entry for batch in seen for entry in batch) == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_samples_of_a_replay_buffer_keep_all_but_the_reward(agent):
    batch = namedtuple("Batch", "observations actions next_observations dones rewards")
    states, actions, _ = transitions(2.0, 4.0)
    sampled = batch(states, actions, states, tensor([[0.0], [1.0]]), tensor([[-1.0], [-1.0]]))
    added = FirstEntry(agent, weight=0.5, **PLAIN).apply(sampled)
    assert added.rewards.tolist() == [[0.5], [1.5]]
    assert added.dones is sampled.dones and added.observations is sampled.observations


def test_states_come_in_units_of_their_deviation_and_at_most_five(agent):
    intrinsic = FirstEntry(agent, normalize="none")
    assert intrinsic.reward(*transitions(3.0)).tolist() == [3.0]
    intrinsic.state_moments.update(tensor([[0.0, 7.0], [4.0, 7.0]]))
    # The mean is 2, the deviation 2; the second entry does not vary.
    states, _, _ = intrinsic.vectors(*transitions(3.0, 2.0, 1000.0))
    assert states[:, 0].tolist() == [0.5, 0.0, 5.0]
    assert states[:, 1].tolist() == [-5.0, -5.0, -5.0]


def test_actions_as_vectors():
    continuous = agent_with(spaces.Box(-2.0, 2.0, (2,)))
    assert continuous.actions(tensor([[0.5, -3.0]])).tolist() == [[0.5, -1.0]]
    discrete = agent_with(spaces.Discrete(3))
    assert discrete.actions(tensor([2, 0])).tolist() == [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    assert discrete.actions(tensor([[1]])).tolist() == [[0.0, 1.0, 0.0]]


def test_infinite_reward_stops_the_learning(agent):
    intrinsic = FirstEntry(agent, **PLAIN)
    with pytest.raises(NumericalError, match="intrinsic_reward is inf"):
        intrinsic.mix(torch.zeros(2), *transitions(1.0, math.inf))
