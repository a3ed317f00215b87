import argparse

import pytest

from scilab_rl.cli.parser import CommandParser, positive
from scilab_rl.errors import ConfigError


@pytest.fixture
def parser():
    parser = CommandParser("runs", "List.")
    parser.add_argument("--status", choices=("failed", "finished"))
    parser.add_argument("--last", type=positive)
    return parser


def test_an_unknown_option_is_one_line_with_a_suggestion(parser):
    with pytest.raises(ConfigError) as raised:
        parser.parse_args(["--statsu=failed"])
    assert "'--statsu'" in str(raised.value)
    assert "Did you mean '--status'?" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert raised.value.exit_code == 2


def test_options_are_not_abbreviated(parser):
    with pytest.raises(ConfigError, match="--sta"):
        parser.parse_args(["--sta", "failed"])


@pytest.mark.parametrize(
    "arguments", [["--status", "lost"], ["--last", "0"], ["--last", "x"], ["word"]]
)
def test_wrong_values_are_named(parser, arguments):
    with pytest.raises(ConfigError, match=arguments[-1]):
        parser.parse_args(arguments)


def test_right_values_are_parsed(parser):
    options = parser.parse_args(["--last", "3", "--status", "failed"])
    assert options == argparse.Namespace(last=3, status="failed")
