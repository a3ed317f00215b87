"""The trained agents in the package: each loads, plays, and is as good as its card says."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.acceptance.agents import PAGE_FILE, card_page, measure, read_card
from scilab_rl.analysis.estimates import success_interval
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import SHIPPED_AGENTS
from scilab_rl.deployment.export import write_policy
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.run.directory import CONFIG_FILE, all_agents, find_policy, find_run
from scilab_rl.run.player import load_player
from scilab_rl.training import checkpoint
from scilab_rl.training.evaluation import evaluate

ROOT = Path(__file__).parents[2]
LIMIT_BYTES = 8_000_000
SHIPPED = sorted(name for name, folder in all_agents().items() if folder.parent == SHIPPED_AGENTS)
N_EPISODES = 100
# Packages that are extras, by what needs them.
NEEDS = {"jax": "jax", "parking": "highway_env", "MetaW": "metaworld", "LunarLander": "Box2D"}
pytestmark = pytest.mark.filterwarnings("ignore:.*not within the observation space")


@pytest.fixture(params=SHIPPED)
def agent(request):
    found = find_run(f"agent:{request.param}", Path("data"))
    card = read_card(found.path)
    for word, package in NEEDS.items():
        if word in f"{card['algorithm']} {card['env']}" and not importlib.util.find_spec(package):
            pytest.skip(f"needs {package}")
    return found


def test_there_are_agents_and_they_are_small() -> None:
    assert {"CartPole", "FetchReach", "Reach1DOF"} <= set(SHIPPED)
    files = [path for path in SHIPPED_AGENTS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LIMIT_BYTES
    kinds = {".safetensors", ".npy", ".json", ".jsonl", ".yaml", ".md"}
    assert {path.suffix for path in files} <= kinds, "nothing that can be executed"


def test_it_plays_an_episode_and_says_what_it_thinks(agent) -> None:
    env, model = load_player(
        load_recorded(agent / CONFIG_FILE), find_policy(agent, "finished"), record=False
    )
    evaluation = evaluate(model, env, 1, seed=1)
    assert len(evaluation.episodes[0].rewards) > 1
    observation = env.reset()
    is_dict = isinstance(observation, dict)
    first = {key: entry[0] for key, entry in observation.items()} if is_dict else observation[0]
    assert np.isfinite(AgentInspector(model).value(first))
    env.close()


def test_its_card_is_complete_and_holds_nothing_of_a_machine(agent) -> None:
    card = read_card(agent.path)
    assert (agent / PAGE_FILE).read_text(encoding="utf-8") == "\n".join(card_page(card)) + "\n"
    assert card["agent"] == agent.path.name
    assert card["evaluation"]["episodes"] >= 1000 and len(card["evaluation"]["seeds"]) == 5
    assert card["training"]["curve"] and card["training"]["steps"] and card["training"]["minutes"]
    assert card["training"]["machine"]["processor"] and card["fingerprint"]
    declared = f'license = "{card["license"]}"'
    assert declared in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    manifest = checkpoint.verify(find_policy(agent, "finished"))
    assert manifest["step"] <= card["training"]["steps"]
    for path in agent.path.rglob("*"):
        if path.suffix in (".json", ".jsonl", ".yaml", ".md"):
            assert not re.search(r"[\"' ]/\w", path.read_text(encoding="utf-8")), path


@pytest.mark.slow
def test_its_exported_policy_acts_the_same(agent, tmp_path) -> None:
    report = write_policy(agent, find_policy(agent, "finished"), tmp_path / "policy")
    assert report["observations"] == 10_000 and report["numpy"] <= 1e-5
    assert report["onnx"] is None or report["onnx"] <= 1e-5


@pytest.mark.slow
def test_it_is_as_good_as_its_card_says(agent) -> None:
    card = read_card(agent.path)["evaluation"]
    found = measure(agent, card["seeds"][:1], N_EPISODES)["evaluation"]
    if "success" in card:
        n_successes = round(found["success"]["mean"] * N_EPISODES)
        interval = success_interval(n_successes, N_EPISODES)
        assert interval.low <= card["success"]["mean"] <= interval.high, interval
    else:
        low, high = (found["return"][end] for end in ("low", "high"))
        assert low <= card["return"]["mean"] <= high, found["return"]
