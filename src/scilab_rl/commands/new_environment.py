"""``scilab-rl new environment NAME --from TEMPLATE``: an environment of your own, in one file."""

from __future__ import annotations

import keyword
import re
from pathlib import Path

from scilab_rl import files
from scilab_rl.commands.new import write_new
from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import write
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.workspace import DESK_ENVS, open_desk

_FOLDER = Path("src") / DESK_ENVS
_TESTS = Path("tests")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,59}")
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
_TEST = '''"""The exam that every environment takes, for {env_id}: python -m pytest {path}"""

import pytest

from scilab_rl.testing.goal_environments import EnvironmentContract
from scilab_rl.workspace import open_desk


class Test{cls}(EnvironmentContract):
    env = "{env_id}"

    @pytest.fixture(autouse=True)
    def _desk(self) -> None:
        open_desk()
'''


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("new environment", "Create an environment of your own from a small one.")
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
            f" There are: {', '.join(TEMPLATES)}."
        )
    open_desk()
    create(options.name, options.template)
    return 0


def create(name: str, template: str) -> None:
    """Write the environment's file, its registration and its exam, and say what to do with them.

    Args:
        name: A Python module's name; ``my_reach`` becomes ``MyReach-v0``.
        template: A key of `TEMPLATES`.

    Raises:
        ConfigError: If the name cannot be one or is taken, or a file cannot be written.
    """
    _check_name(name)
    cls = "".join(word.capitalize() for word in name.split("_"))
    env_id = f"{cls}-v0"
    module, test = _FOLDER / f"{name}.py", _TESTS / f"test_{name}.py"
    for path in (module, test):
        if path.exists():
            raise ConfigError(f"'{path}' exists already; choose another name.")
    source_name, limit = TEMPLATES[template]
    source = files_folder() / f"{source_name}.py"
    package = _FOLDER / "__init__.py"
    registered = package.read_text(encoding="utf-8") if package.exists() else _PACKAGE_DOCSTRING
    write_new(
        {
            module: source.read_text(encoding="utf-8").replace(_CLASS, cls),
            test: _TEST.format(env_id=env_id, cls=cls, path=test),
        }
    )
    files.write_text(package, _with_registration(registered, env_id, f"{name}:{cls}", limit))
    command = "python src/main.py" if Path("src/main.py").is_file() else "scilab-rl"
    write(f"{module}: class {cls}, from {template}; change it here")
    write(f"{package}: {env_id} is registered with {limit} steps per episode")
    write(f"{test}: its exam, run by: python -m pytest {test}")
    write(f"Check it with: {command} doctor env={env_id}")
    write(f"Train in it with: {command} env={env_id}")


def files_folder() -> Path:
    """Return the folder of the templates."""
    return Path(__file__).parents[1] / "envs" / "templates"


def _with_registration(package: str, env_id: str, target: str, limit: int) -> str:
    """Return the package's source with one more registration at its end."""
    if not re.search(r"(?m)^import gymnasium$", package):
        package = f"{package.rstrip()}\n\nimport gymnasium\n"
    entry_point = f"{DESK_ENVS}.{target}"
    return (
        f"{package.rstrip()}\n\ngymnasium.register(\n"
        f'    "{env_id}", entry_point="{entry_point}", max_episode_steps={limit}\n)\n'
    )


def _check_name(name: str) -> None:
    """Refuse a name that is no module's or is taken.

    Raises:
        ConfigError: If it is none.
    """
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ConfigError(
            f"'{name}' is no name for an environment: use up to 60 lower-case letters, digits and "
            "_, a letter first, for example my_reach."
        )
    from scilab_rl.envs.registration import known_env_ids

    env_id = "".join(word.capitalize() for word in name.split("_")) + "-v0"
    if env_id in known_env_ids():
        raise ConfigError(f"There is an environment {env_id} already; choose another name.")
