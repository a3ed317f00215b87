import pytest

from scilab_rl.cli import algorithms

from .conftest import read_json, read_table, write_file


@pytest.fixture
def listed(project, capsys):
    """Return a function that lists the algorithms by name."""

    def run() -> dict[str, dict]:
        assert algorithms.main(["--json"]) == 0
        return {row["algorithm"]: row for row in read_json(capsys.readouterr().out)}

    return run


def test_what_the_shipped_algorithms_can_do(listed):
    rows = listed()
    for row in rows.values():
        assert row["problem"] is None
        assert row["where"] == "shipped"
        assert row["description"]
    for name, actions, hindsight in (
        ("sac", ["Box"], "yes"),
        ("dqn", ["Discrete"], "yes"),
        ("ppo", ["Box", "Discrete", "MultiDiscrete", "MultiBinary"], "no"),
        ("crossq", ["Box"], "no"),  # it reads no goals
    ):
        assert (rows[name]["actions"], rows[name]["hindsight"]) == (actions, hindsight), name


def test_a_desk_algorithm_is_listed_with_its_comment(project, listed):
    source = "import stable_baselines3\n\n\nclass MINE(stable_baselines3.SAC):\n    pass\n"
    write_file(project / "src/custom_algorithms/__init__.py", "")
    write_file(project / "src/custom_algorithms/mine.py", source)
    yaml = "# My idea.\ndefaults: [sac]\nname: mine\n_target_: custom_algorithms.mine.MINE\n"
    write_file(project / "conf/algorithm/mine.yaml", yaml + "replay_buffer_class: null\n")
    row = listed()["mine"]
    assert row["problem"] is None
    assert (row["where"], row["description"], row["hindsight"]) == ("project", "My idea.", "off")
    assert row["class"] == "custom_algorithms.mine.MINE"


def test_broken_algorithms_are_listed_with_the_reason(project, listed):
    broken = {
        "nowhere": ("_target_: custom_algorithms.nowhere.CLASS", "custom_algorithms"),
        "typo": ("_target_: stable_baselines3.SACK", "Did you mean 'SAC'"),
        "parameter": ("_target_: stable_baselines3.SAC\ngama: 1", "Did you mean 'gamma'"),
        "empty": ("name: empty", "_target_"),
        "bracket": ("name: [", "bracket.yaml"),
        "syntax": ("_target_: custom_algorithms.syntax.CLASS", "SyntaxError"),
    }
    for name, (yaml, _) in broken.items():
        write_file(project / f"conf/algorithm/{name}.yaml", yaml + "\n")
    write_file(project / "src/custom_algorithms/__init__.py", "")
    write_file(project / "src/custom_algorithms/syntax.py", "this is no Python\n")
    rows = listed()
    for name, (_, reason) in broken.items():
        assert reason in rows[name]["problem"]
        assert rows[name]["where"] == "project"
    assert rows["sac"]["problem"] is None


def test_plain_lines_name_no_problem_where_there_is_none(project, capsys):
    algorithms.main([])
    rows = read_table(capsys.readouterr().out)
    assert "problem" not in rows[0]
    assert next(row for row in rows if row["algorithm"] == "a2c")["actions"].startswith(
        "Box, Discrete"
    )
