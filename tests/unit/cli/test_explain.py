from pathlib import Path

import pytest

from scilab_rl.cli import explain
from scilab_rl.config.workspace import SHIPPED_CONF
from scilab_rl.errors import ConfigError

from .conftest import read_json, read_table, write_file


@pytest.fixture
def explained(project, capsys):
    """Return a function that returns (value, layer, source) of keys, the final one first."""

    def run(*words: str) -> list[tuple]:
        assert explain.main([*words, "--json"]) == 0
        rows = read_json(capsys.readouterr().out)
        return [(row["value"], row["layer"], row["source"]) for row in rows]

    return run


@pytest.fixture
def layered(project):
    """A project with a file in each layer, all of which set gamma."""
    algorithm = "defaults: [ddpg]\nname: mine\ngamma: 0.1\nbuffer_size: 500\n"
    write_file(project / "conf/algorithm/mine.yaml", algorithm)
    tuned = (
        "# @package _global_\nalgorithm:\n  gamma: 0.2\n  policy_kwargs:\n    net_arch: [8, 8]\n"
    )
    write_file(project / "conf/tuned_values/CartPole/mine.yaml", tuned)
    experiment = (
        "# @package _global_\ndefaults:\n  - override /algorithm: mine\n"
        "env: CartPole-v1\nalgorithm:\n  gamma: 0.3\n"
    )
    write_file(project / "conf/performance/test.yaml", experiment)
    return project


SHIPPED = (0.99, "algorithm", str(SHIPPED_CONF / "algorithm" / "ddpg.yaml"))
PROJECT = (0.1, "algorithm", "conf/algorithm/mine.yaml")
TUNED = (0.2, "tuned values", "conf/tuned_values/CartPole/mine.yaml")
EXPERIMENT = (0.3, "experiment", "conf/performance/test.yaml")


def test_a_default_comes_from_main_yaml(explained):
    assert explained("n_epochs") == [(60, "main", str(SHIPPED_CONF / "main.yaml"))]


def test_later_layers_come_first(explained, layered):
    key = "algorithm.gamma"
    typed = (0.4, "command line", "++algorithm.gamma=0.4")
    assert explained(key, "algorithm=mine") == [PROJECT, SHIPPED]
    assert explained(key, "algorithm=mine", "env=CartPole-v1") == [TUNED, PROJECT, SHIPPED]
    assert explained(key, "algorithm=mine", "env=CartPole", "tuned=false") == [PROJECT, SHIPPED]
    assert explained(key, "+performance=test") == [EXPERIMENT, TUNED, PROJECT, SHIPPED]
    assert explained(key, "+performance=test", "algorithm.gamma=0.4")[:2] == [typed, EXPERIMENT]


def test_a_group_stands_for_its_keys(project, layered, capsys):
    explain.main(["algorithm", "algorithm=mine"])
    keys = [row["key"] for row in read_table(capsys.readouterr().out) if row["state"] == "final"]
    assert len(keys) == len(set(keys)) > 10
    assert {
        "algorithm.name",
        "algorithm.gamma",
        "algorithm.replay_buffer_kwargs.n_sampled_goal",
    } <= {*keys}


def test_nested_values_and_replaced_mappings(explained, layered):
    words = ("algorithm=mine", "env=CartPole-v1")
    net = "algorithm.policy_kwargs.net_arch"
    assert explained(net, *words) == [([8, 8], *TUNED[1:])]
    key = "algorithm.policy_kwargs"
    rows = explained(key, *words, f"++{key}=null")
    assert [row[0] for row in rows] == [None, {"net_arch": [8, 8]}, None]


def test_a_mapping_on_the_command_line_sets_the_keys_below(explained):
    rows = explained("env_kwargs.reward_type", "+env_kwargs={reward_type: dense}")
    assert rows == [("dense", "command line", "++env_kwargs={reward_type: dense}")]


def test_an_interpolation_is_shown_with_its_value(explained):
    (value, layer, source), *_ = explained("tracking.wandb.enabled", "wandb=1")
    assert (value, layer) == (1, "tracking")
    assert source.endswith("wandb.yaml as ${wandb}")


def test_plain_lines_show_values_as_typed(project, capsys):
    explain.main(["tags", "info", "env", "env=FetchPush"])
    rows = read_table(capsys.readouterr().out)
    assert [(row["value"], row["state"]) for row in rows] == [
        ("null", "final"),
        ("''", "final"),
        ("FetchPush", "final"),
        ("FetchReach", "before"),
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["learning_rate"], "Did you mean 'algorithm.learning_rate'"),
        (["algorithm.gama"], "Did you mean 'algorithm.gamma'"),
        (["n_epoch"], "Did you mean 'n_epochs'"),
        (["env", "algorithm=sax"], "Did you mean 'sac'"),
        (["env", "n_epochz=3"], "Did you mean 'n_epochs'"),
        (["env", "n_epochs=0"], "n_epochs must be at least 1"),
        (["env=FetchPush"], "Which key"),
    ],
)
def test_mistakes_are_explained(project, words, message):
    with pytest.raises(ConfigError, match=message) as raised:
        explain.main(words)
    assert raised.value.exit_code == 2


def test_the_source_exists(explained, layered):
    for _, layer, source in explained("algorithm", "+performance=test"):
        assert layer in ("algorithm", "tuned values", "experiment")
        assert Path(source).is_file()
