"""``scilab-rl compare`` with tables of choices, models and agents."""

import json
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.analysis.fitting.simulation import simulate
from scilab_rl.analysis.report import write_table
from scilab_rl.cli.main import run_command_line
from scilab_rl.errors import ConfigError

TRUE = {"learning_rate": np.full(4, 0.5), "inverse_temperature": np.full(4, 8.0)}
QUICK = ("eval_after_n_steps=40", "n_epochs=1", "n_test_rollouts=1", "mlflow=0")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A folder with choices of people in a bandit, and with two agents."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("project"))
        rows = simulate(RESCORLAWAGNER, TRUE, "Bandit-reversal-a2", n_trials=50)
        write_table(rows, Path("people.csv"))
        write_table([{**row, "env": ""} for row in rows], Path("unnamed.csv"))
        write_table([{**row, "env": "TwoStep"} for row in rows], Path("other.csv"))
        write_table([{"participant_id": 1, "response": 0}], Path("short.csv"))
        for seed in (1, 2):
            words = ("algorithm=rescorlawagner", "algorithm.learning_rate=0.9", f"seed={seed}")
            kwargs = "+env_kwargs.n_trials=30"
            assert run_command_line(["env=Bandit-reversal-a2", *words, kwargs, *QUICK]) == 0
        yield


@pytest.fixture
def compared(project, capsys):
    """Compare and return what is printed."""

    def compare(*words):
        capsys.readouterr()
        assert run_command_line(["compare", *words, "--json"]) == 0
        rows = json.loads(capsys.readouterr().out)["behavior"]
        return {(r["group"], r["behavior"]): r for r in rows if r["place"] is None}

    return compare


def test_people_agents_and_models_stand_side_by_side(compared):
    found = compared("people.csv", "agent=rescorlawagner", "model:rescorlawagner", "--episodes=5")
    groups = dict.fromkeys(group for group, _ in found)
    assert list(groups) == ["people", "agent", "rescorlawagner"]
    people, agent, model = (found[group, "after a win"] for group in groups)
    assert (people["n"], agent["n"], model["n"]) == (4, 2, 4)  # people, runs, fitted people
    assert abs(model["mean"] - people["mean"]) < 0.1


def test_a_single_agent_is_measured_over_its_episodes(compared):
    found = compared("people.csv", "last=last", "--episodes=6")
    last = found["last", "after a loss"]
    assert (last["n"], last["unit"]) == (6, "blocks")
    assert last["low"] < last["mean"] < last["high"]  # it chooses by chance


def test_without_people_a_model_has_the_parameters_of_its_yaml(compared):
    found = compared("model:rescorlawagner", "chance=model:randomchoice", "--env=Bandit")
    learner, chance = (found[group, "after a win"] for group in ("rescorlawagner", "chance"))
    assert learner["mean"] > 0.8 > 0.6 > chance["mean"] > 0.4
    assert learner["n"] == 20


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("people.csv",), "two groups"),
        (("people.csv", "people=unnamed.csv"), "same name"),
        (("people.csv", "none.csv"), "There is no table 'none.csv'"),
        (("people.csv", "short.csv"), "no column 'feedback'"),
        (("people.csv", "other.csv"), "people Bandit-reversal-a2-v0, other TwoStep-v0"),
        (("unnamed.csv", "model:randomchoice"), "add --env TASK"),
        (("people.csv", "model:randomchoise"), "Did you mean 'randomchoice'"),
        (("people.csv", "model:hybrid"), "use model=rescorlawagner"),
        (("people.csv", "agent:nobody"), "nobody"),
        (("people.csv", "agent:Reach1DOF"), "env=Reach1DOF-v0 is not a choice task"),
        (("people.csv", "model:hybrid", "--metric", "x"), "--metric is for comparisons of runs"),
        (("rescorlawagner", "sac", "--softmax", "2"), "--softmax is for comparisons of choices"),
    ],
)
def test_what_cannot_be_compared_is_named(project, words, message):
    from scilab_rl.cli.compare import main

    with pytest.raises(ConfigError, match=message):
        main(list(words))


def test_models_draw_the_choices_that_are_exported(project, capsys):
    assert run_command_line(["export", "last", "--trials", "--episodes=2", "--output=t.csv"]) == 0
    text = Path("t.csv").read_text().splitlines()
    place = text[0].split(",").index("response")
    first, second = (
        [line.split(",")[place] for line in text[1:] if line.split(",")[5] == episode]
        for episode in "01"
    )
    assert len(first) == len(second) == 30 and first != second
