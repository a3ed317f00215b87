"""``scilab-rl new intrinsic NAME --from PARENT``: create an intrinsic reward as a copy."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

from scilab_rl.cli.new import camel, check_identifier, new_files, program, renamed, write_new
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import write
from scilab_rl.config.workspace import PROJECT_ALGORITHMS, open_project
from scilab_rl.errors import ConfigError, did_you_mean, listing

_TEST = '''"""The contract test of cleansac with {name}: python -m pytest {path}"""

from scilab_rl.testing.algorithms import AlgorithmContract


class Test{camel}(AlgorithmContract):
    algorithm = "cleansac"
    arguments = {{"intrinsic": "{name}"}}
'''


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("new intrinsic", "Create an intrinsic reward of your own as a copy.")
    parser.add_argument("name", help="its name, for example my_curiosity")
    parser.add_argument(
        "--from", dest="parent", default="rnd", metavar="PARENT", help="which to copy (default rnd)"
    )
    options = parser.parse_args(arguments)
    open_project()
    check_identifier(options.name, "intrinsic reward")
    test = Path("tests") / f"test_{options.name}.py"
    source = PROJECT_ALGORITHMS / f"{options.name}.py"
    contents = new_files(
        {
            source: source_of(options.name, options.parent),
            test: _TEST.format(name=options.name, camel=camel(options.name), path=test),
        }
    )
    write_new(contents)
    write(f"{source}: class {camel(options.name)}, a copy of {options.parent}; change it here")
    write(f"{test}: its contract test, run by: python -m pytest {test}")
    write(f"Train with it: {program()} algorithm=cleansac algorithm.intrinsic={options.name}")
    return 0


def source_of(name: str, parent: str) -> str:
    """Return the source of a shipped intrinsic reward with its class renamed.

    Raises:
        ConfigError: If there is no such reward, or the name is taken.
    """
    from scilab_rl.algorithms.intrinsic.build import INTRINSIC_REWARDS

    if name in INTRINSIC_REWARDS:
        raise ConfigError(f"The intrinsic reward '{name}' exists; choose another name.")
    if parent not in INTRINSIC_REWARDS:
        raise ConfigError(
            f"There is no intrinsic reward '{parent}' to copy."
            f"{did_you_mean(parent, INTRINSIC_REWARDS)} There are: {listing(INTRINSIC_REWARDS)}."
        )
    module, _, cls = INTRINSIC_REWARDS[parent].rpartition(".")
    source = inspect.getsource(importlib.import_module(module))
    file = f"{module.replace('.', '/')}.py"
    return f"# A copy of {file}. Say here what is different.\n{renamed(source, {cls: camel(name)})}"
