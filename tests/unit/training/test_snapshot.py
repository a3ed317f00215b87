import json
import random
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from scilab_rl.errors import CheckpointError
from scilab_rl.training.snapshot import capture, random_state, restore, set_random_state

BOX = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


class Learner:
    """What an idea may add to an algorithm: a network, a counter, a generator, a schedule."""

    def __init__(self, fill=0.0):
        self.network = torch.nn.Linear(2, 2)
        torch.nn.init.constant_(self.network.weight, fill)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=0.1)
        self.schedule = torch.optim.lr_scheduler.StepLR(self.optimizer, step_size=1)
        self.log_alpha = torch.nn.Parameter(torch.full((1,), fill))
        self.n_updates = 0
        self.name = "learner"
        self.rates = {"a": fill, "nested": [fill, {"deep": np.full(3, fill)}]}
        self.recent = deque([fill], maxlen=3)
        self.pair = (1, fill)
        self.generator = np.random.default_rng(1)
        self.torch_generator = torch.Generator()
        self.space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32, seed=1)
        self.noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))
        self.loss = lambda: 0.0

    def learn(self):
        self.optimizer.zero_grad()
        self.network(torch.ones(1, 2)).sum().backward()
        self.optimizer.step()
        self.schedule.step()
        self.n_updates += 1
        self.recent.append(float(self.n_updates))

    def draw(self):
        return [
            *self.generator.random(3),
            *torch.rand(3, generator=self.torch_generator).tolist(),
            *self.space.sample(),
            *self.noise(),
        ]


def transported(snapshot):
    """The tree must survive being text."""
    snapshot.tree = json.loads(json.dumps(snapshot.tree))
    return snapshot


def test_a_learner_continues_where_the_other_one_was():
    original, copy = Learner(1.0), Learner(0.0)
    for _ in range(3):
        original.learn()
    original.draw()
    np.random.seed(0)
    restore({"learner": copy}, transported(capture({"learner": original})))
    np.random.seed(0)
    drawn = original.draw()
    np.random.seed(0)
    assert copy.draw() == drawn
    original.learn()
    copy.learn()
    assert torch.equal(copy.network.weight, original.network.weight)
    assert copy.optimizer.param_groups[0]["lr"] == original.optimizer.param_groups[0]["lr"]
    assert copy.log_alpha.item() == 1.0
    assert copy.n_updates == 4
    assert copy.recent == original.recent == deque([2.0, 3.0, 4.0], maxlen=3)
    assert copy.pair == (1, 1.0)
    assert copy.rates["nested"][1]["deep"].tolist() == [1.0, 1.0, 1.0]


def test_optimizers_keep_the_parameters_they_change():
    copy = Learner(0.0)
    restore({"learner": copy}, capture({"learner": Learner(1.0)}))
    assert copy.optimizer.param_groups[0]["params"][0] is copy.network.weight


def test_counters_and_loose_tensors_inside_modules_are_kept():
    class Normalizer(torch.nn.Module):
        def __init__(self, count):
            super().__init__()
            self.count = count
            self.offset = torch.full((2,), float(count))

    one, other = torch.nn.Sequential(Normalizer(5)), torch.nn.Sequential(Normalizer(0))
    restore({"net": other}, transported(capture({"net": one})))
    assert other[0].count == 5
    assert other[0].offset.tolist() == [5.0, 5.0]


def filled_buffer(n, n_envs=1, size=10):
    buffer = ReplayBuffer(size * n_envs, BOX, BOX, n_envs=n_envs)
    for i in range(n):
        values = np.full((n_envs, 2), i, np.float32)
        buffer.add(values, values, values, np.full(n_envs, i), np.zeros(n_envs), [{}] * n_envs)
    return buffer


@pytest.mark.parametrize("n", [0, 1, 4, 10, 13])
def test_replay_buffers_keep_only_what_they_hold(n):
    buffer, copy = filled_buffer(n), filled_buffer(0)
    snapshot = transported(capture({"buffer": buffer}))
    assert len(snapshot.arrays["buffer.rewards"]) == min(n, 10)
    storage = copy.rewards
    restore({"buffer": copy}, snapshot)
    assert (copy.pos, copy.full) == (n % 10, n >= 10)
    assert np.array_equal(copy.rewards, buffer.rewards)
    assert copy.rewards is storage


def test_captured_buffers_are_views():
    buffer = filled_buffer(4)
    assert np.shares_memory(capture({"b": buffer}).arrays["b.observations"], buffer.observations)


def test_arrays_of_another_length_in_a_buffer_are_kept_whole():
    """One row, three environments: a per-environment array must not be cut to one."""
    buffer, copy = filled_buffer(1, n_envs=3), filled_buffer(0, n_envs=3)
    buffer.started, copy.started = np.array([7, 8, 9]), np.zeros(3, int)
    restore({"buffer": copy}, capture({"buffer": buffer}))
    assert copy.started.tolist() == [7, 8, 9]


def test_buffers_can_be_left_out():
    snapshot = capture({"buffer": filled_buffer(4)}, with_buffers=False)
    assert snapshot.arrays == {}
    assert capture({"buffer": RolloutBuffer(4, BOX, BOX)}).arrays == {}


def test_a_smaller_buffer_is_refused():
    snapshot = capture({"buffer": filled_buffer(8)})
    with pytest.raises(
        CheckpointError, match=r"buffer\.\w+ has shape \(8, 1, 2\), not \(5, 1, 2\)"
    ):
        restore({"buffer": filled_buffer(0, size=5)}, snapshot)


def test_weights_of_another_shape_are_refused():
    one, other = Learner(), Learner()
    one.log_alpha = torch.nn.Parameter(torch.zeros(2))
    with pytest.raises(CheckpointError, match=r"log_alpha has shape \(2,\), not \(1,\)"):
        restore({"learner": other}, capture({"learner": one}))
    one, other = Learner(), Learner()
    one.network = torch.nn.Linear(3, 2)
    with pytest.raises(CheckpointError, match="size mismatch"):
        restore({"learner": other}, capture({"learner": one}))


def test_a_missing_layer_is_refused():
    bigger = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Linear(2, 2))
    smaller = torch.nn.Sequential(torch.nn.Linear(2, 2))
    with pytest.raises(CheckpointError, match="no saved values"):
        restore({"net": bigger}, capture({"net": smaller}))


@pytest.mark.parametrize(
    "node",
    [
        {"@kind": "no such kind"},
        {"@kind": "tensor", "name": "missing"},
        {"@kind": "array"},
        {"@kind": "object", "attributes": [1]},
        {"@kind": "module", "path": "x", "names": ["y"], "attributes": {}},
        {"@kind": "optimizer", "groups": [], "state": {"@kind": "dict", "entries": {}}},
    ],
)
def test_a_nonsensical_tree_is_one_error(node):
    snapshot = capture({})
    snapshot.tree = {"value": node}
    with pytest.raises(CheckpointError, match="does not fit"):
        restore({"value": torch.nn.Linear(1, 1)}, snapshot)


def test_only_attributes_that_exist_are_set():
    class Plain:
        def __init__(self):
            self.known = 0

    snapshot = capture({})
    attributes = {"known": 1, "unknown": 2, "__class__": "Evil", "__dict__": {}}
    snapshot.tree = {"plain": {"@kind": "object", "attributes": attributes}}
    plain = Plain()
    restore({"plain": plain}, snapshot)
    assert vars(plain) == {"known": 1}
    assert type(plain) is Plain


def test_the_global_generators_repeat():
    random.seed(1)
    np.random.seed(1)
    torch.manual_seed(1)
    np.random.normal()  # leaves a cached second number
    state = restore({"random": None}, transported(capture({"random": random_state()})))["random"]

    def draw():
        return [
            random.random(),
            random.gauss(0, 1),
            *np.random.normal(size=3),
            torch.rand(1).item(),
        ]

    first = draw()
    set_random_state(state)
    assert draw() == first
