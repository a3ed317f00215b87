"""Making a trained agent from a run, and using it where a run is named."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from scilab_rl.acceptance.agents import card_page, measure, read_card, write_agent
from scilab_rl.analysis.estimates import success_interval
from scilab_rl.cli.main import run_command_line
from scilab_rl.config.compose import compose
from scilab_rl.config.recorded import load_recorded
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, find_agent, find_policy, find_run
from scilab_rl.run.run import start_run

TRAIN = [
    "env=scilab_rl.testing:TinyReach-v0", "algorithm=cleansac", "n_epochs=2", "seed=3", "mlflow=0",
    "eval_after_n_steps=60", "n_test_rollouts=2", "tuned=false", "algorithm.net_arch=[8]",
    "algorithm.batch_size=8", "algorithm.learning_starts=20", "++tracking.console.enabled=false",
]  # fmt: skip


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    return RunDirectory(Path(start_run(compose(TRAIN)).run_dir).resolve())


@pytest.fixture
def agent(run, tmp_path, capsys):
    assert run_command_line(["export", "last", "--agent", "Tiny", "--episodes", "15"]) == 0
    capsys.readouterr()
    return tmp_path / "agents" / "Tiny"


def files_of(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def test_the_card_says_what_was_measured(agent, run):
    card = read_card(agent)
    assert card["agent"] == "Tiny" and card["license"] == "MIT"
    assert card["env"].endswith("TinyReach-v0") and card["algorithm"] == "cleansac"
    training = card["training"]
    assert training["steps"] == 120 and training["seed"] == 3
    assert [step for step, _ in training["curve"]] == [60, 120]
    assert training["machine"]["processor"] and training["machine"]["cores"] >= 1
    provenance = json.loads((run / "provenance.json").read_text())
    assert card["fingerprint"] == provenance["fingerprint"]
    assert card["versions"]["torch"] == provenance["versions"]["torch"]
    evaluation = card["evaluation"]
    assert evaluation["episodes"] == 15 and evaluation["seeds"] == [1, 2, 3, 4, 5]
    success = evaluation["success"]
    assert success["mean"] == pytest.approx(sum(success["per_seed"]) / 5, abs=1e-3)
    n_successes = round(15 * success["mean"])
    assert success["low"] == pytest.approx(success_interval(n_successes, 15).low, abs=1e-4)
    assert card["known_failures"]["episodes"] == 15 - n_successes
    page = (agent / "README.md").read_text()
    assert page == "\n".join(card_page(card)) + "\n"
    assert "scilab-rl play agent:Tiny" in page and "| 120 |" in page


def test_measuring_again_gives_the_same_and_failed_goals_are_where_they_were(agent):
    card = read_card(agent)
    again = measure(RunDirectory(agent), [1, 2, 3, 4, 5], 3)
    assert again == {key: card[key] for key in again}
    failures = card["known_failures"]
    assert failures["episodes"] > 0, "an agent of 120 steps"
    # Within 0.2 an episode has succeeded, and the square has a diagonal of 2.83.
    assert 0.2 < failures["final_distance"]["mean"] <= failures["final_distance"]["highest"] < 2.83
    for dimension in range(2):
        low, mean, high = (
            failures["goals"]["failed"][k][dimension] for k in ("low", "mean", "high")
        )
        assert failures["goals"]["all"]["low"][dimension] <= low <= mean <= high <= 1


def test_an_older_agent_of_the_name_is_replaced(agent, tmp_path):
    (agent / "older.txt").write_text("")
    assert run_command_line(["export", "last", "--agent", "Tiny", "--episodes", "5"]) == 0
    assert read_card(agent)["evaluation"]["episodes"] == 5
    assert not (agent / "older.txt").exists() and len(list((tmp_path / "agents").iterdir())) == 1


def test_nothing_of_this_machine_is_kept(agent, tmp_path):
    for name, content in files_of(agent).items():
        if name.suffix in (".json", ".jsonl", ".yaml", ".md"):
            assert str(tmp_path) not in content.decode(), name
            assert not re.search(r"[\"' ]/\w", content.decode()), name
    assert load_recorded(agent / CONFIG_FILE).base_logdir == "data"


def test_it_is_found_played_and_compared_and_never_changed(agent, tmp_path, capsys):
    before = files_of(agent)
    assert find_agent("Tiny") == Path("agents/Tiny")
    found = find_run("agent:Tiny", Path("data"))
    assert str(found) == "agent:Tiny" and found.outputs == Path("data/agents/Tiny")
    assert find_run(str(agent), Path("data")).is_agent
    assert find_policy(found, "agent:Tiny", "best") == Path("agents/Tiny/rl_model_finished")
    assert run_command_line(["play", "agent:Tiny", "--episodes", "2"]) == 0
    assert "success" in capsys.readouterr().out
    assert run_command_line(["export", "agent:Tiny", "--episodes", "2"]) == 0
    assert (tmp_path / "data" / "agents" / "Tiny" / "trials_step.csv").is_file()
    assert str(find_run("data/agents/Tiny", Path("data"))) == "agent:Tiny"
    assert run_command_line(["compare", "agent:Tiny", "last"]) == 0
    assert files_of(agent) == before


def test_a_run_starts_from_it(agent, capsys):
    assert (
        run_command_line([*TRAIN, "restore_policy=agent:Tiny", "algorithm.learning_starts=0"]) == 0
    )
    assert run_command_line([*TRAIN, "restore_policy=agent:Tini"]) == 2
    assert "Did you mean 'Tiny'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["play", "agent:Tini"], "There is no agent 'Tini'. Did you mean 'Tiny'?"),
        (["resume", "agent:Tiny"], "restore_policy=agent:Tiny"),
        (["sync", "agent:Tiny"], "not a run of yours"),
        (["view", "agent:Tiny"], "scilab-rl play agent:Tiny --record"),
        (["export", "agent:Tiny", "--agent", "Other"], "not a run of yours"),
        (["export", "last", "--agent", "../Tiny"], "An agent's name"),
        (["export", "last", "--agent", "Other", "--episodes", "12"], "multiple of 5"),
    ],
)
def test_what_makes_no_sense_is_one_line(agent, arguments, message, capsys):
    before = files_of(agent)
    assert run_command_line(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert files_of(agent) == before and not Path("agents/Other").exists()


def test_an_agent_that_cannot_be_measured_leaves_the_old_one(agent, run, monkeypatch):
    before = files_of(agent)
    monkeypatch.setattr("scilab_rl.acceptance.agents.measure", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_agent(run, run / "rl_model_best", "Tiny", agent.parent, n_episodes=5, license="MIT")
    assert files_of(agent) == before and len(list(agent.parent.iterdir())) == 1


def test_a_run_without_an_evaluation_is_refused(run, tmp_path):
    (run / "metrics.jsonl").unlink()
    with pytest.raises(ConfigError, match="no evaluation yet"):
        write_agent(run, run / "rl_model_best", "A", tmp_path, n_episodes=5, license="MIT")
