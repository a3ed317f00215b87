"""Intrinsic rewards inside of the algorithms that learn from them."""

import numpy as np
import pytest
import torch

from scilab_rl.algorithms.intrinsic.build import INTRINSIC_REWARDS, make_intrinsic_reward
from scilab_rl.errors import ConfigError
from scilab_rl.learning.arguments import check_arguments
from scilab_rl.learning.declared import recorded_metrics
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.logger import as_number
from scilab_rl.testing.algorithms import _generators

from .conftest import differences_of_the_learner, small

# Every reward in every kind of algorithm: one-file off-policy, on-policy, Stable-Baselines3.
QUICK = {("cleansac", "rnd"), ("sac", "critic_variance")}
PAIRS = [
    pytest.param(algorithm, name, marks=[] if is_quick else pytest.mark.slow)
    for algorithm in ("cleansac", "cleanppo", "sac", "dqn")
    for name in INTRINSIC_REWARDS
    if name != "critic_variance" or algorithm not in ("cleanppo", "dqn")
    for is_quick in [algorithm in ("cleanppo", "dqn") or (algorithm, name) in QUICK]
]


@pytest.mark.parametrize(("algorithm", "name"), PAIRS)
def test_weight_zero_equals_no_intrinsic_reward_bit_for_bit(contract, algorithm, name):
    plain = contract(algorithm).trained()
    weightless = contract(algorithm, small(name, weight=0.0)).trained()
    assert differences_of_the_learner(plain, weightless) == []
    assert "train/intrinsic_reward" in weightless.logger.name_to_value


@pytest.mark.parametrize(("algorithm", "name"), PAIRS)
def test_interrupted_and_resumed_equals_uninterrupted(contract, algorithm, name, tmp_path):
    contract = contract(algorithm, small(name, weight=0.5))
    contract.test_continues_as_if_it_had_not_been_interrupted(tmp_path)


def test_resume_restores_models_optimizers_and_statistics(contract, tmp_path):
    """What the contract compares includes the intrinsic reward's own state."""
    from scilab_rl.training.snapshot import capture, restore

    model = contract("cleansac", small("rnd")).trained()
    fresh = contract("cleansac", small("rnd")).build(seed=8)
    restore({"algorithm": fresh}, capture({"algorithm": model}))
    one, other = model.intrinsic, fresh.intrinsic
    for name in ("target", "predictor"):
        for saved, loaded in zip(
            getattr(one, name).parameters(), getattr(other, name).parameters(), strict=True
        ):
            assert torch.equal(saved, loaded)
    assert other.optimizer.state_dict()["state"][0]["step"] == one.n_updates == other.n_updates > 0
    assert torch.equal(one.state_moments.mean, other.state_moments.mean)
    assert one.state_moments.count == other.state_moments.count
    assert torch.equal(one.normalization.moments.variance, other.normalization.moments.variance)
    assert one.random.random() == other.random.random()


@pytest.mark.parametrize("algorithm", ["cleansac", "cleanppo", "sac"])
def test_weight_changes_what_is_learned(contract, algorithm):
    weightless = contract(algorithm, small("rnd", weight=0.0)).trained()
    curious = contract(algorithm, small("rnd", weight=1.0)).trained()
    assert differences_of_the_learner(weightless, curious) != []


def test_hindsight_samples_carry_the_mixed_reward(contract):
    model = contract("sac", small("rnd", weight=0.5, normalize="none")).trained()
    buffer, intrinsic = model.replay_buffer, model.intrinsic
    assert buffer.intrinsic is intrinsic
    state = buffer.random.bit_generator.state
    with torch.no_grad():
        buffer.intrinsic = None
        plain = buffer.sample(64)
        expected = intrinsic.reward(plain.observations, plain.actions, plain.next_observations)
        buffer.intrinsic = intrinsic
    buffer.random.bit_generator.state = state
    mixed = buffer.sample(64)
    assert set(plain.rewards.flatten().tolist()) == {-1.0, 0.0}  # some goals were put in
    torch.testing.assert_close(mixed.rewards.flatten(), 0.5 * plain.rewards[:, 0] + 0.5 * expected)
    assert torch.equal(mixed.observations["desired_goal"], plain.observations["desired_goal"])


def test_desired_goal_is_no_part_of_the_state(contract):
    intrinsic = contract("sac", small("rnd", normalize_states=False)).build().intrinsic
    space = intrinsic.agent.algorithm.observation_space
    before = {key: torch.as_tensor(entry.sample()[None]) for key, entry in space.spaces.items()}
    moved_goal = {**before, "desired_goal": before["desired_goal"] + 1.0}
    moved_arm = {**before, "observation": before["observation"] + 1.0}
    actions = torch.zeros(1, 2)

    def reward(observations):
        return intrinsic.reward(observations, actions, observations).item()

    assert reward(moved_goal) == reward(before) != reward(moved_arm)


@pytest.mark.parametrize("algorithm", ["cleansac", "cleanppo", "sac", "dqn"])
def test_reward_of_steps_is_what_is_learned_from_them(contract, algorithm):
    """Observations and actions of the environment and of the algorithm mean the same."""
    model = contract(algorithm, small("disagreement")).build(n_envs=3)
    env = model.get_env()
    before = env.reset()
    actions = np.array([env.action_space.sample() for _ in range(3)])
    after, _, _, _ = env.step(actions)
    rewards = AgentInspector(model).intrinsic_rewards(before, actions, after)
    assert rewards.shape == (3,)
    intrinsic, space = model.intrinsic, env.observation_space
    keys = [key for key in space.spaces if key != "desired_goal"]
    states, next_states = (
        torch.as_tensor(np.concatenate([batch[key] for key in keys], axis=1)).float()
        for batch in (before, after)
    )
    if hasattr(env.action_space, "n"):
        vectors = torch.eye(int(env.action_space.n))[actions]
    else:
        vectors = torch.as_tensor(actions)  # the bounds of the tiny environments are -1 and 1
    intrinsic.agent.states = lambda batch: batch
    intrinsic.agent.actions = lambda batch: batch
    expected = intrinsic.reward(states, vectors, next_states)
    torch.testing.assert_close(torch.as_tensor(rewards), expected)


def test_construction_and_questions_draw_no_global_random_numbers(contract):
    model = contract("sac").build()
    before = _generators()
    intrinsic = make_intrinsic_reward("icm", model)
    observations = model.get_env().reset()
    intrinsic.evaluate(observations, np.zeros((1, 2), np.float32), observations)
    assert _generators() == before


def test_seed_decides_the_weights_of_the_models(contract):
    weights = [
        contract("sac", small("rnd")).build(seed=seed).intrinsic.target[0].weight
        for seed in (7, 7, 8)
    ]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_only_curious_algorithms_answer_for_an_intrinsic_reward(contract):
    assert "intrinsic_reward" not in AgentInspector(contract("sac").build()).quantities
    curious = contract("sac", small("rnd")).build()
    assert "intrinsic_reward" in AgentInspector(curious).quantities
    assert {"train/intrinsic_reward_step", "train/intrinsic_loss"} <= recorded_metrics(
        curious
    ).names
    plain = recorded_metrics(contract("sac").build())
    assert "train/intrinsic_reward_step" not in plain.names
    assert "algorithm.intrinsic" in plain.absent["train/intrinsic_reward_step"]


def test_a_reward_of_ones_own(contract, monkeypatch):
    from types import ModuleType

    from .test_mixing import FirstEntry

    module = ModuleType("custom_algorithms.my_curiosity")
    module.FirstEntry, module.NotOne = FirstEntry, dict
    monkeypatch.setitem(__import__("sys").modules, "custom_algorithms.my_curiosity", module)
    model = contract("cleansac", "custom_algorithms.my_curiosity.FirstEntry").trained()
    assert isinstance(model.intrinsic, FirstEntry)
    assert as_number(model.logger.name_to_value["train/intrinsic_reward"]) != 0.0
    with pytest.raises(ConfigError, match="not a subclass of IntrinsicReward"):
        contract("cleansac", "custom_algorithms.my_curiosity.NotOne").build()


REFUSALS = [
    ("cleansac", "rdn", r"Did you mean 'rnd'\?"),
    ("cleansac", {"weight": 0.5}, "must name an intrinsic reward"),
    ("cleansac", "os.system", "must name an intrinsic reward"),
    ("cleansac", "custom_algorithms.nowhere.Idea", "cannot be found"),
    ("cleansac", {"name": "rnd", "wieght": 0.5}, r"Did you mean 'weight'\?"),
    ("cleansac", {"name": "rnd", "beta": 0.5}, "no setting 'beta'"),
    ("sac", {"name": "rnd", "weight": 1.5}, "from 0 to 1, but it is 1.5"),
    ("sac", {"name": "rnd", "weight": "much"}, "from 0 to 1, but it is 'much'"),
    ("sac", {"name": "rnd", "normalize": "minmax"}, r"Did you mean 'min_max'\?"),
    ("cleanppo", "critic_variance", "CLEANPPO has 0"),
    ("ddpg", "critic_variance", "DDPG has 1"),
]


@pytest.mark.parametrize(("algorithm", "intrinsic", "message"), REFUSALS)
def test_what_cannot_be_is_refused(contract, algorithm, intrinsic, message):
    with pytest.raises(ConfigError, match=message):
        contract(algorithm, intrinsic).build()


def test_returns_over_several_steps_have_no_intrinsic_reward(contract):
    with pytest.raises(ConfigError, match=r"n_steps=1"):
        contract("sac", "rnd", n_steps=3, replay_buffer_class=None).build()


def test_on_policy_algorithms_of_stable_baselines3_have_no_such_parameter():
    from stable_baselines3 import PPO

    with pytest.raises(ConfigError, match=r"no parameter algorithm\.intrinsic"):
        check_arguments("ppo", PPO, {"intrinsic": "rnd"})
