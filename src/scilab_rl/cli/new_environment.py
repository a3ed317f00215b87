"""``scilab-rl new environment NAME --from TEMPLATE``: create an environment in one file."""

from __future__ import annotations

import re
from pathlib import Path

from scilab_rl import files
from scilab_rl.cli.new import camel, check_identifier, program, write_new
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import write
from scilab_rl.config.workspace import PROJECT_ENVS, open_project
from scilab_rl.errors import ConfigError, did_you_mean

_FOLDER = Path("src") / PROJECT_ENVS
_TESTS = Path("tests")
_CLASS = "MyTask"
# Template -> its file and the step limit of its copies.
TEMPLATES = {
    "minimal": ("minimal", 50),
    "FetchReach": ("fetch_reach", 50),
    "Blocks": ("blocks", 100),
    "PointMaze": ("point_maze", 300),
}
_PACKAGE_DOCSTRING = (
    '"""Your environments: one file each, made known here with ``gymnasium.register(...)``."""\n'
)
_TEST = '''"""The contract test of every environment, for {env_id}: python -m pytest {path}"""

import pytest

from scilab_rl.testing.goal_environments import EnvironmentContract
from scilab_rl.config.workspace import open_project


class Test{cls}(EnvironmentContract):
    env = "{env_id}"

    @pytest.fixture(autouse=True)
    def _project(self) -> None:
        open_project()
'''


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("new environment", "Create an environment of your own from a template.")
    parser.add_argument("name", help="its name, for example my_reach")
    parser.add_argument(
        "--from",
        dest="template",
        default="minimal",
        metavar="TEMPLATE",
        help=f"one of {', '.join(TEMPLATES)} (default minimal)",
    )
    options = parser.parse_args(arguments)
    if options.template not in TEMPLATES:
        raise ConfigError(
            f"There is no template '{options.template}'.{did_you_mean(options.template, TEMPLATES)}"
            f" Templates: {', '.join(TEMPLATES)}."
        )
    open_project()
    create(options.name, options.template)
    return 0


def create(name: str, template: str) -> None:
    """Write the environment's file, registration and contract test, and print the next steps.

    Args:
        name: A Python module's name; ``my_reach`` becomes ``MyReach-v0``.
        template: A key of `TEMPLATES`.

    Raises:
        ConfigError: If the name is invalid or taken, or a file cannot be written.
    """
    from scilab_rl.envs.registration import known_env_ids

    check_identifier(name, "environment")
    cls = camel(name)
    env_id = f"{cls}-v0"
    if env_id in known_env_ids():
        raise ConfigError(f"The environment {env_id} already exists; choose another name.")
    module, test = _FOLDER / f"{name}.py", _TESTS / f"test_{name}.py"
    for path in (module, test):
        if path.exists():
            raise ConfigError(f"'{path}' already exists; choose another name.")
    source_name, limit = TEMPLATES[template]
    source = Path(__file__).parents[1] / "envs" / "templates" / f"{source_name}.py"
    package = _FOLDER / "__init__.py"
    registered = package.read_text(encoding="utf-8") if package.exists() else _PACKAGE_DOCSTRING
    write_new(
        {
            module: source.read_text(encoding="utf-8").replace(_CLASS, cls),
            test: _TEST.format(env_id=env_id, cls=cls, path=test),
        }
    )
    files.write_text(package, _with_registration(registered, env_id, f"{name}:{cls}", limit))
    write(f"{module}: class {cls}, from {template}; change it here")
    write(f"{package}: {env_id} is registered with {limit} steps per episode")
    write(f"{test}: its contract test, run by: python -m pytest {test}")
    write(f"Check it with: {program()} doctor env={env_id}")
    write(f"Train in it with: {program()} env={env_id}")


def _with_registration(package: str, env_id: str, target: str, limit: int) -> str:
    """Return the package's source with one more registration at its end."""
    if not re.search(r"(?m)^import gymnasium$", package):
        package = f"{package.rstrip()}\n\nimport gymnasium\n"
    entry_point = f"{PROJECT_ENVS}.{target}"
    return (
        f"{package.rstrip()}\n\ngymnasium.register(\n"
        f'    "{env_id}", entry_point="{entry_point}", max_episode_steps={limit}\n)\n'
    )
