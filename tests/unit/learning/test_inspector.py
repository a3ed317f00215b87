from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.vec_env import VecNormalize

import scilab_rl.testing  # noqa: F401 - registers the tiny environments
from scilab_rl.algorithms.cleansac import CLEANSAC
from scilab_rl.algorithms.random import RANDOM
from scilab_rl.building import policy_name
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_train_env
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.probes import EpisodeProbes, built_in


def small() -> dict[str, Any]:
    return {"policy_kwargs": {"net_arch": [8]}, "seed": 3, "device": "cpu"}


ACTOR = frozenset({"q_values", "value", "log_prob", "entropy"})
CRITIC = frozenset({"q_values", "value"})
STATE = frozenset({"value", "log_prob", "entropy"})


def make_env(env_id: str = "TinyBox-v0") -> Any:
    return make_train_env(RunConfig(env_id, seed=1))


def first_step(algorithm: Any) -> tuple[Any, Any]:
    """Return an observation of the environment and an action of the algorithm."""
    batch = algorithm.get_env().reset()
    actions, _ = algorithm.predict(batch, deterministic=True)
    single = {k: v[0] for k, v in batch.items()} if isinstance(batch, dict) else batch[0]
    return single, 0.5 * actions[0] if actions.dtype.kind == "f" else actions[0]


@pytest.mark.parametrize(
    ("cls", "env_id", "quantities", "n_critics"),
    [
        (stable_baselines3.SAC, "TinyBox-v0", ACTOR, 2),
        (stable_baselines3.SAC, "TinyReach-v0", ACTOR | {"goals"}, 2),
        (stable_baselines3.TD3, "TinyBox-v0", CRITIC, 2),
        (stable_baselines3.DDPG, "TinyBox-v0", CRITIC, 1),
        (sb3_contrib.TQC, "TinyBox-v0", ACTOR, 2),
        (sb3_contrib.CrossQ, "TinyBox-v0", ACTOR, 2),
        (stable_baselines3.DQN, "TinyDiscrete-v0", CRITIC, 1),
        (sb3_contrib.QRDQN, "TinyDiscrete-v0", CRITIC, 1),
        (stable_baselines3.PPO, "TinyBox-v0", STATE, 0),
        (stable_baselines3.PPO, "TinyDiscrete-v0", STATE, 0),
        (stable_baselines3.A2C, "TinyReach-v0", STATE | {"goals"}, 0),
        (sb3_contrib.TRPO, "TinyBox-v0", STATE, 0),
        (sb3_contrib.RecurrentPPO, "TinyBox-v0", STATE, 0),
        (sb3_contrib.RecurrentPPO, "TinyReach-v0", STATE | {"goals"}, 0),
    ],
)
def test_each_stable_baselines_algorithm_answers(
    cls: type, env_id: str, quantities: frozenset[str], n_critics: int
) -> None:
    env = make_env(env_id)
    inspector = AgentInspector(cls(policy_name(env, cls), env, **small()))
    assert inspector.quantities == quantities | ({"second critic"} if n_critics > 1 else set())
    observation, action = first_step(inspector.algorithm)
    with inspector.undisturbed():
        if n_critics:
            assert inspector.q_values(observation, action).shape == (n_critics,)
        for name in quantities & {"value", "entropy"}:
            assert math.isfinite(getattr(inspector, name)(observation))
        if "log_prob" in quantities:
            assert math.isfinite(inspector.log_prob(observation, action))


def test_q_values_and_value_of_sac_are_those_of_its_networks() -> None:
    algorithm = stable_baselines3.SAC("MlpPolicy", make_env(), **small())
    inspector = AgentInspector(algorithm)
    observation, action = first_step(algorithm)
    tensor = torch.as_tensor(observation)[None]
    with torch.no_grad():
        asked = torch.cat(algorithm.critic(tensor, torch.as_tensor(action)[None]), dim=1)[0]
        best = algorithm.actor(tensor, deterministic=True)
        mean = torch.cat(algorithm.critic(tensor, best), dim=1).mean()
    with inspector.undisturbed():
        np.testing.assert_allclose(inspector.q_values(observation, action), asked, rtol=1e-6)
        assert inspector.value(observation) == pytest.approx(float(mean), rel=1e-5)


def test_entropy_of_a_squashed_normal_is_near_the_integral() -> None:
    """H = H_normal + E[log(1 - tanh(u)^2)], per dimension by Gauss-Hermite quadrature."""
    algorithm = stable_baselines3.SAC("MlpPolicy", make_env(), **small())
    observation, _ = first_step(algorithm)
    with torch.no_grad():
        mean, log_std, _ = algorithm.actor.get_action_dist_params(
            torch.as_tensor(observation)[None]
        )
    nodes, weights = np.polynomial.hermite_e.hermegauss(64)
    expected = 0.0
    for mu, sigma in zip(mean[0].numpy(), log_std[0].exp().numpy(), strict=True):
        squashing = np.log(1 - np.tanh(mu + sigma * nodes) ** 2 + 1e-12)
        expected += 0.5 * math.log(2 * math.pi * math.e * sigma**2)
        expected += (weights @ squashing) / weights.sum()
    inspector = AgentInspector(algorithm)
    with inspector.undisturbed():
        estimate = inspector.entropy(observation)
        assert estimate == inspector.entropy(observation)
    assert estimate == pytest.approx(expected, abs=0.25)


def test_one_file_algorithm_is_asked_with_its_own_methods() -> None:
    algorithm = CLEANSAC(env=make_env("TinyReach-v0"), n_critics=3, net_arch=[8], seed=1)
    inspector = AgentInspector(algorithm)
    assert inspector.quantities == ACTOR | {"goals", "second critic"}
    observation, action = first_step(algorithm)
    batch = {key: value[None] for key, value in observation.items()}
    expected = algorithm.q_values(batch, action[None])[0]
    assert torch.equal(torch.as_tensor(inspector.q_values(observation, action)), expected)


def test_random_has_no_inside() -> None:
    assert AgentInspector(RANDOM(env=make_env())).quantities == frozenset()


def test_asking_changes_nothing() -> None:
    algorithm = stable_baselines3.SAC("MlpPolicy", make_env(), **small())
    inspector = AgentInspector(algorithm)
    observation, _ = first_step(algorithm)
    algorithm.policy.set_training_mode(True)
    before = (torch.get_rng_state(), np.random.get_state()[1].copy())
    with inspector.undisturbed():
        inspector.entropy(observation)
        np.random.random()
        assert not algorithm.policy.training
    assert torch.equal(before[0], torch.get_rng_state())
    assert np.array_equal(before[1], np.random.get_state()[1])
    assert algorithm.policy.training


def test_normalised_observations_and_rewards_are_what_the_critics_learn() -> None:
    env = VecNormalize(make_env())
    algorithm = stable_baselines3.SAC("MlpPolicy", env, **small())
    env.reset()
    for _ in range(20):
        env.step(np.array([env.action_space.sample()]))
    observation, action = env.get_original_obs()[0], np.zeros(2, np.float32)
    normalised = torch.as_tensor(env.normalize_obs(observation[None]))
    with torch.no_grad():
        expected = torch.cat(algorithm.critic(normalised.float(), torch.zeros(1, 2)), dim=1)[0]
    inspector = AgentInspector(algorithm)
    np.testing.assert_allclose(inspector.q_values(observation, action).ravel(), expected, rtol=1e-5)
    scale = math.sqrt(float(env.ret_rms.var) + env.epsilon)
    assert inspector.learned_reward(-2.0) == pytest.approx(max(-10.0, -2.0 / scale))


def test_a_recurrent_policy_is_asked_with_its_memory() -> None:
    """The probes of an episode say what acting has computed at each of its steps."""
    model = sb3_contrib.RecurrentPPO("MlpLstmPolicy", make_env("CueMemory-v0"), **small())
    env, states = model.get_env(), copy.deepcopy(model._last_lstm_states)
    asked = EpisodeProbes(
        AgentInspector(model), [built_in("td_error"), built_in("log_prob")], print
    )
    seen, start, previous = env.reset(), torch.ones(1), None
    for _ in range(4):
        with torch.no_grad():
            acted = model.policy(torch.as_tensor(seen), states, start)
        action, value, log_prob, states = acted
        if previous is not None:  # r + gamma V(s') - V(s), where no answer is asked for: r = 0
            surprise = model.gamma * value.item() - previous[0]
            assert previous[1]["td_error"] == pytest.approx(surprise, abs=1e-6)
        after = env.step(action.numpy())[0]
        said = asked.of_step(seen[0], action.numpy()[0], 0.0, after[0], {}, False, False)
        previous = value.item(), {curve.panel: number for curve, number in said.items()}
        assert previous[1]["log_prob"] == pytest.approx(log_prob.item(), abs=1e-6)
        seen, start = after, torch.zeros(1)
    fresh = AgentInspector(model)
    with fresh.undisturbed():
        remembered = fresh.after(np.eye(6, dtype=np.float32)[0]).value(seen[0])
        assert remembered != fresh.value(seen[0])  # and a new episode remembers nothing
