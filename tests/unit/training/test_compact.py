"""The small policy of a trained agent acts and answers as the saved one does."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from scilab_rl.config.compose import compose
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.run.player import load_player
from scilab_rl.run.run import start_run
from scilab_rl.training import checkpoint
from scilab_rl.training.compact import compact

# An algorithm, its environment, and where its target networks and what they follow are.
PAIRS = {
    "cleansac": ("TinyReach-v0", ["critic_target", "critic"]),
    "cleandqn": ("TinyDiscrete-v0", ["target_network", "q_network"]),
    "cleanppo": ("TinyBox-v0", None),
    "sac": ("TinyReach-v0", ["policy.critic_target", "policy.critic"]),
    "td3": ("TinyBox-v0", ["policy.actor_target", "policy.actor"]),
    "dqn": ("TinyDiscrete-v0", ["policy.q_net_target", "policy.q_net"]),
    "jaxsac": ("TinyReach-v0", None),
    "jaxtd3": ("TinyBox-v0", None),
    "jaxcrl": ("TinyReach-v0", None),
    "jaxgciql": ("TinyReach-v0", None),
    "recurrentppo": ("TinyBox-v0", None),
}


@pytest.fixture(params=PAIRS)
def trained(request, tmp_path, monkeypatch):
    """The configuration of a short run and its saved policy."""
    if request.param.startswith("jax") and importlib.util.find_spec("jax") is None:
        pytest.skip("needs the extra [jax]")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    sizes = {name: ["algorithm.n_steps=20"] for name in ("cleanppo", "recurrentppo")}
    sizes["jaxgciql"] = ["algorithm.batch_size=8", "algorithm.data=random:3"]
    small = ["algorithm.batch_size=8", "algorithm.learning_starts=20"]
    sizes_of_nets = "++algorithm.policy_kwargs.net_arch=[8]"
    if request.param.startswith(("clean", "jax")):
        sizes_of_nets = "algorithm.net_arch=[8]"
    cfg = compose(
        [f"env=scilab_rl.testing:{PAIRS[request.param][0]}", f"algorithm={request.param}",
         "n_epochs=1", "seed=3", "mlflow=0", "eval_after_n_steps=60", "n_test_rollouts=1",
         "tuned=false", "++tracking.console.enabled=false", sizes_of_nets,
         *sizes.get(request.param, small)]
    )  # fmt: skip
    return cfg, Path(start_run(cfg).run_dir) / "rl_model_finished"


def test_it_acts_and_answers_the_same_and_is_smaller(trained, tmp_path):
    cfg, saved = trained
    small = tmp_path / "small"
    whole = checkpoint.load(saved)
    checkpoint.save(compact(whole), small, step=60)
    assert not any("optimizer" in name for name in compact(whole).tensors)
    assert _n_numbers(compact(whole)) < 0.6 * _n_numbers(whole)
    env, model = load_player(cfg, saved, record=False)
    copy_env, copy = load_player(cfg, small, record=False)
    env.seed(5)
    observation = env.reset()
    for _ in range(20):
        action = model.predict(observation, deterministic=True)[0]
        np.testing.assert_array_equal(copy.predict(observation, deterministic=True)[0], action)
        observation = env.step(action)[0]
    one = {k: v[0] for k, v in observation.items()} if isinstance(observation, dict) else None
    one = observation[0] if one is None else one
    asked = [AgentInspector(algorithm) for algorithm in (model, copy)]
    assert asked[0].quantities == asked[1].quantities
    if "value" in asked[0].quantities:
        assert asked[0].value(one) == asked[1].value(one)
    else:
        assert asked[0].similarity(one, action[0]) == asked[1].similarity(one, action[0])
    env.close()
    copy_env.close()


def test_target_networks_are_those_that_they_follow(trained, tmp_path):
    cfg, saved = trained
    checkpoint.save(compact(checkpoint.load(saved)), tmp_path / "small", step=60)
    env, model = load_player(cfg, tmp_path / "small", record=False)
    env.close()
    if (paths := PAIRS[cfg.algorithm.name][1]) is not None:
        target, online = (_at(model, path).state_dict() for path in paths)
        assert target.keys() == online.keys()
        assert all(torch.equal(target[name], online[name]) for name in target)
    elif cfg.algorithm.name in ("jaxsac", "jaxtd3"):
        state, networks = model.rounds.state, model.rounds.networks
        for name in ("critic", "critic_target"):
            for layer, shown in zip(state[name], networks["critic"], strict=True):
                np.testing.assert_array_equal(np.asarray(layer["weight"]), shown["weight"])


def _at(model, path):
    for name in path.split("."):
        model = getattr(model, name)
    return model


def _n_numbers(snapshot):
    return sum(t.numel() for t in snapshot.tensors.values()) + sum(
        a.size for a in snapshot.arrays.values()
    )
