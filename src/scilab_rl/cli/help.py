"""``scilab-rl --help`` and ``--help all``. No heavy import, so that both are instant."""

from __future__ import annotations

import itertools
import math
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping

import yaml

from scilab_rl.cli.tables import as_typed, write
from scilab_rl.config.schema import ALIASES, KEYS, Key
from scilab_rl.config.workspace import SHIPPED_CONF, config_files

_EXAMPLES = (
    ("scilab-rl", "train with the defaults"),
    ("scilab-rl algorithm=sac env=FetchPush n_epochs=20 seed=1", "change keys"),
    (
        "scilab-rl ++algorithm.learning_rate=0.001 +env_kwargs.reward_type=dense",
        "... and nested ones",
    ),
    ("scilab-rl seed=1,2,3 --multirun", "one run for each value"),
)
_FLAGS = (
    ("--multirun, -m", "run all combinations of the values that are separated by commas"),
    ("--cfg job", "show the configuration and do not run"),
    ("--debug", "show the full traceback of an error"),
    ("--trust-pickle", "load a policy from a zip of Stable-Baselines3, which can run any code"),
    ("--trust-module=NAME", "import the module that the environment of a recorded run names"),
    ("--version", "show the version"),
    ("--help, -h", "show this; `scilab-rl COMMAND --help` shows the options of a command"),
)
_FIRST_LINES = (
    ("scilab-rl env=FetchReach algorithm=jaxsac", "train"),
    ("scilab-rl play last --record", "film what was learned"),
    ("scilab-rl view last", "look inside, step by step"),
    ("scilab-rl COMMAND --help", "options of a command"),
)
# Commands by purpose; others follow in the last row.
_PURPOSES = {
    "Watch": ("play", "view", "goals", "whatif", "probe", "human"),
    "Runs": ("runs", "board", "plot", "resume", "note", "tag", "delete"),
    "Compare": ("experiment", "compare", "study", "performance", "fit", "recover"),
    "Change": ("new", "algorithms", "envs", "explain", "profile"),
    "Data": ("export", "dataset", "mlflow", "sync"),
}
_FIRST_KEYS = (
    "env", "n_epochs", "eval_after_n_steps", "seed", "n_envs", "render", "restore_policy",
)  # fmt: skip
_WIDEST, _LEFT = 100, 32


def print_help(commands: Mapping[str, str]) -> None:
    """Print the help of the command line.

    Args:
        commands: The sub-commands and their purposes.
    """
    width = min(_WIDEST, shutil.get_terminal_size((_WIDEST, 24)).columns)
    for line in _lines(commands, width):
        write(line)
    sys.stdout.flush()


def print_short_help(commands: Mapping[str, str]) -> None:
    """Print what is needed first, in at most 30 lines of 80 columns.

    Args:
        commands: The sub-commands and their purposes.
    """
    width = min(_WIDEST, shutil.get_terminal_size((_WIDEST, 24)).columns)
    for line in _short_lines(commands, width):
        write(line)
    sys.stdout.flush()


def _short_lines(commands: Mapping[str, str], width: int) -> Iterable[str]:
    yield from textwrap.wrap("Train robots and other agents by reinforcement learning.", width)
    yield ""
    for words, meaning in _FIRST_LINES:
        yield f"  {words:<44}{meaning}"
    sorted_out = {name for names in _PURPOSES.values() for name in names}
    others = tuple(name for name in commands if name not in sorted_out)
    yield from ("", "Commands")
    for purpose, row in {**_PURPOSES, "Other": others}.items():
        yield f"  {purpose:<10}{', '.join(name for name in row if name in commands)}"
    keys = [key for key in KEYS if key.name in _FIRST_KEYS]
    facts = [(f"{key.name}={as_typed(key.default)}", key.meaning) for key in keys]
    yield from _section("Keys that are needed first", facts, width)
    yield ""
    yield from textwrap.wrap(
        "Everything: scilab-rl --help all. The values of a run: scilab-rl ... --cfg job", width
    )


def _lines(commands: Mapping[str, str], width: int) -> Iterable[str]:
    yield from textwrap.wrap("Train robots and other agents by reinforcement learning.", width)
    yield from _section(
        "Usage: scilab-rl [KEY=VALUE ...] or scilab-rl COMMAND ...", _EXAMPLES, width
    )
    yield from _section("Commands", commands.items(), width)
    yield from _section("Flags", _FLAGS, width)
    yield from _section("Groups: a file each, of ours or in conf/", _groups(), width)
    for heading, keys in itertools.groupby(KEYS, key=lambda key: key.heading):
        facts = [(f"{key.name}={as_typed(key.default)}", _meaning(key)) for key in keys]
        yield from _section(heading, facts, width)
    wrappers = [(f"+{alias}=1", "") for alias in ALIASES]
    yield from _section("Wrappers around the environment", wrappers, width)


def _section(title: str, facts: Iterable[tuple[str, str]], width: int) -> Iterable[str]:
    yield ""
    yield from textwrap.wrap(title, width)
    for name, meaning in facts:
        yield from _fact(name, meaning, width)


def _fact(name: str, meaning: str, width: int) -> list[str]:
    """Return ``name`` and its meaning in two columns, or below each other in a narrow terminal."""
    in_columns = width >= 2 * _LEFT
    indent = " " * (_LEFT if in_columns else 6)
    described = textwrap.wrap(meaning, width, initial_indent=indent, subsequent_indent=indent)
    if in_columns and described and len(name) + 4 <= _LEFT:
        return [f"  {name}".ljust(_LEFT) + described[0].lstrip(), *described[1:]]
    return [f"  {name}", *described]


def _groups() -> Iterable[tuple[str, str]]:
    main = yaml.safe_load((SHIPPED_CONF / "main.yaml").read_text(encoding="utf-8"))
    chosen = next(entry["algorithm"] for entry in main["defaults"] if "algorithm" in entry)
    yield f"algorithm={chosen}", f"one of {', '.join(config_files('algorithm'))}"
    experiments = ", ".join(config_files("performance")) or "none yet"
    yield "+performance=FILE", f"the configuration of an experiment: {experiments}"


def _meaning(key: Key) -> str:
    least = f" from {key.low:g}" if key.low > -math.inf else ""
    return f"{key.meaning} ({' | '.join(key.allowed)}{least}{' | null' if key.optional else ''})"
