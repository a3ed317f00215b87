import logging
import subprocess
import sys
from importlib import metadata

import gymnasium
import pytest
from gymnasium import spaces

from scilab_rl.cli import envs
from scilab_rl.envs import catalog
from scilab_rl.envs.ids import FAMILIES
from scilab_rl.envs.suites import SUITES, Suite
from scilab_rl.errors import ConfigError

from .conftest import read_json, read_table, write_file


@pytest.fixture
def listed(project, capsys):
    """Return a function that runs the command and returns its rows by id."""

    def run(*names: str) -> dict[str, dict]:
        assert envs.main([*names, "--json"]) == 0
        return {row["env"]: row for row in read_json(capsys.readouterr().out)}

    return run


def test_the_newest_usable_versions_are_listed(listed):
    rows = listed()
    assert rows["FetchReach-v4"] == {
        "env": "FetchReach-v4",
        "steps": 50,
        "observation": "achieved_goal: Box(3), desired_goal: Box(3), observation: Box(10)",
        "action": "Box(4) from -1 to 1",
        "goal": True,
        "suite": "gymnasium_robotics",
        "older": [],
    }
    assert rows["CartPole-v1"]["older"] == ["CartPole-v0"]
    assert rows["CartPole-v1"]["suite"] == "gymnasium"
    assert rows["LunarLander-v3"]["suite"] == "Box2D"
    assert rows["Reach1DOF-v0"]["suite"] == "scilab_rl"
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


def test_an_environment_that_cannot_be_made_is_listed_with_the_reason(project, listed):
    source = 'import gymnasium\n\ngymnasium.register("Broken-v0", entry_point="nowhere:Env")\n'
    write_file(project / "src/custom_envs/__init__.py", source)
    row = listed("Broken")["Broken-v0"]
    assert "nowhere" in row["problem"]
    assert row["action"] is None
    del gymnasium.registry["Broken-v0"]


def test_an_unknown_name_is_refused_with_a_suggestion(project):
    with pytest.raises(ConfigError, match="Did you mean 'FetchPush-v4'"):
        envs.main(["Fetchpuhs"])


def test_plain_lines(project, capsys):
    envs.main([])
    rows = {row["env"]: row for row in read_table(capsys.readouterr().out)}
    assert rows["FetchPush-v4"]["steps"] == "50"
    assert rows["FetchPush-v4"]["older"] == "-"
    assert rows["FetchPush-v4"]["goal"] == "yes"


# Of each package one; what is recorded must be what is made.
@pytest.mark.parametrize(
    "env_id",
    ["CartPole-v1", "FetchPush-v4", "Blocks-v1", "PointObjGym-v0", "ButtonUnlock-v1", "Hopper-v5"],
)
def test_recorded_spaces_are_those_of_the_environment(project, env_id):
    made = catalog.describe(env_id)
    assert catalog.recorded_spaces()[env_id] == {
        key: made[key] for key in ("observation", "action", "goal")
    }


def test_everything_shipped_is_recorded(listed):
    rows = listed()
    shipped = [family.env_id for family in FAMILIES]
    shipped += [env_id for env_id in rows if env_id.startswith("MetaW-")]
    assert [env_id for env_id in shipped if rows[env_id]["action"] is None] == []


def test_what_is_not_recorded_is_unknown(project, listed):
    source = 'import gymnasium\n\ngymnasium.register("Mine-v0", entry_point="nowhere:Env")\n'
    write_file(project / "src/custom_envs/__init__.py", source)
    row = listed()["Mine-v0"]
    assert (row["suite"], row["action"], row["goal"]) == ("nowhere", None, None)
    del gymnasium.registry["Mine-v0"]


def test_suites_tell_what_is_there_how_to_get_the_rest_and_what_conflicts(
    project, capsys, monkeypatch
):
    monkeypatch.setattr(Suite, "installed", False)
    assert envs.main(["--suites", "--json"]) == 0
    rows = {row["suite"]: row for row in read_json(capsys.readouterr().out)}
    assert not rows["metaworld"]["installed"]
    assert rows["metaworld"]["install"] == 'pip install "scilab-rl[metaworld]"'
    assert "mujoco==3.3.0" in rows["metaworld"]["conflicts"]
    assert "-c constraints-myosuite.txt" in rows["myosuite"]["install"]
    assert "metaworld" in rows["myosuite"]["conflicts"]
    assert rows["gymnasium"]["install"] is None


def test_each_extra_of_a_suite_exists(project):
    extras = {key.lower() for key in metadata.metadata("scilab-rl").get_all("Provides-Extra")}
    assert {suite.extra for suite in SUITES if suite.extra} <= extras


def test_the_list_ends_with_what_is_missing(project, caplog, monkeypatch):
    monkeypatch.setattr(logging.getLogger("scilab_rl"), "propagate", True)
    monkeypatch.setitem(vars(SUITES[-1]), "package", "no_such_suite")
    with caplog.at_level(logging.INFO, "scilab_rl"):
        envs.main([])
    assert "Not installed: no_such_suite. Install it with: pip install -c constr" in caplog.text


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
    assert catalog.space_text(space) == text


def test_gymnasium_robotics_is_imported_in_silence():
    code = "from scilab_rl.envs import registration as r; print(r.resolve_env_id('FetchReach'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "FetchReach-v4" in done.stdout
    assert done.stderr == ""
