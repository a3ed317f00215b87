import ast

import pytest

from scilab_rl.algorithms.intrinsic.build import INTRINSIC_REWARDS
from scilab_rl.cli import new
from scilab_rl.cli.new_intrinsic import source_of
from scilab_rl.errors import ConfigError


@pytest.mark.parametrize("parent", INTRINSIC_REWARDS)
def test_every_reward_can_be_copied(parent):
    tree = ast.parse(source_of("my_curiosity", parent))
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert "MyCuriosity" in classes
    assert INTRINSIC_REWARDS[parent].rpartition(".")[2] not in classes


def test_files_are_written_once_and_the_next_steps_are_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", ["src"])
    assert new.main(["intrinsic", "my_curiosity", "--from", "icm"]) == 0
    assert "class MyCuriosity(IntrinsicReward)" in (
        tmp_path / "src/custom_algorithms/my_curiosity.py"
    ).read_text(encoding="utf-8")
    assert 'arguments = {"intrinsic": "my_curiosity"}' in (
        tmp_path / "tests/test_my_curiosity.py"
    ).read_text(encoding="utf-8")
    assert "algorithm.intrinsic=my_curiosity" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="already exists"):
        new.main(["intrinsic", "my_curiosity"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["my_curiosity", "--from", "rdn"], r"no intrinsic reward 'rdn'.* Did you mean 'rnd'\?"),
        (["rnd"], "'rnd' exists"),
        (["My-Idea"], "not a valid name"),
    ],
)
def test_errors_name_what_is_allowed(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", ["src"])
    with pytest.raises(ConfigError, match=message):
        new.main(["intrinsic", *arguments])
    assert not list(tmp_path.iterdir())
