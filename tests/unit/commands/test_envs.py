import logging
import subprocess
import sys

import gymnasium
import pytest
from gymnasium import spaces

from scilab_rl.commands import envs
from scilab_rl.errors import ConfigError

from .conftest import read_json, read_table, write_file


@pytest.fixture
def listed(desk, capsys):
    """Return a function that runs the command and returns its rows by id."""

    def run(*names: str) -> dict[str, dict]:
        assert envs.main([*names, "--json"]) == 0
        return {row["env"]: row for row in read_json(capsys.readouterr().out)}

    return run


def test_the_newest_usable_versions_are_listed(listed):
    rows = listed()
    fetch = {"env": "FetchReach-v4", "steps": 50, "suite": "gymnasium_robotics", "older": []}
    assert rows["FetchReach-v4"] == fetch
    assert rows["CartPole-v1"]["older"] == ["CartPole-v0"]
    assert rows["CartPole-v1"]["suite"] == "gymnasium"
    assert "CartPole-v0" not in rows
    assert not [name for name in rows if name.startswith("GymV2")]


def test_a_part_of_a_name_shows_the_spaces_of_all_that_contain_it(listed):
    rows = listed("fetchreach")
    assert [*rows] == ["FetchReach-v4", "FetchReachDense-v4"]
    assert rows["FetchReach-v4"] == {
        "env": "FetchReach-v4",
        "observation": "achieved_goal: Box(3), desired_goal: Box(3), observation: Box(10)",
        "action": "Box(4) from -1 to 1",
        "goal": True,
        "steps": 50,
        "problem": None,
    }


def test_an_old_id_becomes_the_newest_with_a_notice(listed, caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("scilab_rl"), "propagate", True)
    with caplog.at_level(logging.INFO, "scilab_rl"):
        assert [*listed("FetchReach-v1")] == ["FetchReach-v4"]
    assert "FetchReach-v1 is not available any more" in caplog.text


def test_an_environment_without_goals(listed):
    row = listed("CartPole-v1")["CartPole-v1"]
    assert (row["action"], row["goal"], row["steps"]) == ("Discrete(2)", False, 500)


def test_an_environment_that_cannot_be_made_is_listed_with_the_reason(desk, listed):
    source = 'import gymnasium\n\ngymnasium.register("Broken-v0", entry_point="nowhere:Env")\n'
    write_file(desk / "src/custom_envs/__init__.py", source)
    row = listed("Broken")["Broken-v0"]
    assert "nowhere" in row["problem"]
    assert row["action"] is None
    del gymnasium.registry["Broken-v0"]


def test_an_unknown_name_is_refused_with_a_suggestion(desk):
    with pytest.raises(ConfigError, match="Did you mean 'FetchPush-v4'"):
        envs.main(["Fetchpuhs"])


def test_plain_lines(desk, capsys):
    envs.main([])
    rows = {row["env"]: row for row in read_table(capsys.readouterr().out)}
    assert rows["FetchPush-v4"]["steps"] == "50"
    assert rows["FetchPush-v4"]["older"] == "-"


def test_missing_suites_name_their_extra(monkeypatch):
    monkeypatch.setattr(envs.importlib.util, "find_spec", lambda name: None)
    missing = envs.missing_suites()
    assert missing["gymnasium_robotics"] == 'pip install "scilab-rl[robotics]"'
    assert missing["metaworld"] == 'pip install "scilab-rl[metaworld]"'


@pytest.mark.parametrize(
    ("space", "text"),
    [
        (spaces.Box(-2, 2, (3,)), "Box(3) from -2 to 2"),
        (spaces.Box(0, 255, (8, 8, 3), "uint8"), "Box(8, 8, 3) from 0 to 255"),
        (spaces.Box(1.0, 2.0, ()), "Box() from 1 to 2"),
        (spaces.Box(-float("inf"), 1, (2,)), "Box(2)"),
        (spaces.Discrete(5), "Discrete(5)"),
        (spaces.Dict(a=spaces.Discrete(2)), "a: Discrete(2)"),
    ],
)
def test_short_texts_of_spaces(space, text):
    assert envs.space_text(space) == text


def test_gymnasium_robotics_is_imported_in_silence():
    code = "from scilab_rl.envs import registration as r; print(r.resolve_env_id('FetchReach'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "FetchReach-v4" in done.stdout
    assert done.stderr == ""
