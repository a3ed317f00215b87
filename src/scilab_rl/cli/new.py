"""``scilab-rl new algorithm|model NAME --from PARENT``: create one from an existing one.

As in the paper, a new idea starts as a copy of an algorithm under a new name, in which a few lines
are changed. This command makes the copy, its YAML and its contract test, which run without changes.
"""

from __future__ import annotations

import ast
import inspect
import io
import keyword
import re
import tokenize
from importlib import metadata
from pathlib import Path

import hydra
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from scilab_rl import files
from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import write
from scilab_rl.config.workspace import (
    PROJECT_ALGORITHMS,
    PROJECT_CONF,
    SHIPPED_CONF,
    config_files,
    open_project,
)
from scilab_rl.errors import ConfigError, did_you_mean, listing

_TESTS = Path("tests")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,59}")
_PACKAGE_DOCSTRING = (
    '"""Your algorithms: one file each, with a YAML of the same name in conf/algorithm/."""\n'
)
# Environments to train in, in the order of preference.
_EXAMPLES = ("FetchReach", "Pendulum-v1", "CartPole-v1")
_PARENTS = {"algorithm": "cleansac", "model": "rescorlawagner"}
_TEST = '''"""The contract test of every algorithm, for {name}: python -m pytest {path}"""

from scilab_rl.testing.algorithms import AlgorithmContract


class Test{camel}(AlgorithmContract):
    algorithm = "{name}"
'''
_MODEL_TEST = '''"""The contract tests of cognitive models, for {name}: python -m pytest {path}"""

from scilab_rl.testing.algorithms import AlgorithmContract
from scilab_rl.testing.models import ModelContract


class Test{camel}(ModelContract, AlgorithmContract):
    algorithm = "{name}"
'''


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    if arguments[:1] == ["environment"]:
        from scilab_rl.cli import new_environment

        return new_environment.main(arguments[1:])
    if arguments[:1] == ["intrinsic"]:
        from scilab_rl.cli import new_intrinsic

        return new_intrinsic.main(arguments[1:])
    parser = CommandParser(
        "new",
        "Create an algorithm or a cognitive model of your own as a copy of an existing one, or an "
        "environment or an intrinsic reward (`scilab-rl new environment --help`, "
        "`scilab-rl new intrinsic --help`).",
    )
    kinds = (*_PARENTS, "environment", "intrinsic")
    parser.add_argument("kind", choices=kinds, help="what to create")
    parser.add_argument("name", help="its name, for example my_idea")
    parser.add_argument(
        "--from",
        dest="parent",
        metavar="PARENT",
        help="what to copy (default: cleansac; of a model: rescorlawagner); `scilab-rl algorithms` "
        "lists all",
    )
    options = parser.parse_args(arguments)
    open_project()
    check_name(options.name)
    parent = Parent(options.parent or _PARENTS[options.kind])
    if options.kind == "model" and not parent.is_model:
        raise ConfigError(f"'{parent.name}' is not a cognitive model; use `new algorithm`.")
    contents = contents_of(options.name, parent)
    write_new(contents)
    _explain(options.name, parent, list(contents))
    return 0


class Parent:
    """The algorithm to copy.

    Args:
        name: Its name, shipped or in the project folder.

    Attributes:
        yaml: The text of its YAML.
        cls: Its class.
        source: The source of the file that the class is in.

    Raises:
        ConfigError: If it does not exist, or has no source.
    """

    def __init__(self, name: str) -> None:
        options = config_files("algorithm")
        if name not in options:
            raise ConfigError(
                f"There is no algorithm '{name}' to copy.{did_you_mean(name, options)} "
                f"Algorithms: {listing(options, limit=40)}."
            )
        self.name = name
        self.yaml = options[name].read_text(encoding="utf-8")
        target = (yaml.safe_load(self.yaml) or {}).get("_target_")
        try:
            self.cls: type = hydra.utils.get_class(str(target))
            self.source = inspect.getsource(inspect.getmodule(self.cls))  # type: ignore[arg-type]
        except Exception as error:
            raise ConfigError(
                f"'{options[name]}' names '{target}', which cannot be copied: {error}"
            ) from error

    @property
    def is_model(self) -> bool:
        """Whether it is a cognitive model, which can be fitted to choices."""
        return any(base.__name__ == "CognitiveModel" for base in self.cls.__mro__)

    @property
    def origin(self) -> str:
        """The file, package and version of the source."""
        package, _, rest = self.cls.__module__.partition(".")
        file = f"{package}/{rest.replace('.', '/')}.py"
        try:
            about = metadata.metadata(package).json
            license = about.get("license_expression") or about.get("license")
            return f"{file} ({package} {about['version']}, {license} license)"
        except metadata.PackageNotFoundError:  # of the project folder
            return file


def check_name(name: str) -> None:
    """Check that a name is free, and valid as a module, a YAML file and a word of the command line.

    Raises:
        ConfigError: If it is not.
    """
    check_identifier(name, "algorithm")
    read = OverridesParser.create().parse_override(f"algorithm={name}").value()
    if read != name or yaml.safe_load(name) != name:
        raise ConfigError(
            f"'{name}' is not read as text by YAML or Hydra; choose another name, such as "
            f"my_{name}."
        )
    options = config_files("algorithm")
    if name in options:
        place = "shipped" if options[name].is_relative_to(SHIPPED_CONF) else "yours"
        raise ConfigError(f"The algorithm '{name}' already exists ({place}); choose another name.")


def check_identifier(name: str, kind: str) -> None:
    """Check that a name can be that of a Python module.

    Raises:
        ConfigError: If it cannot.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"'{name}' is not a valid name for an {kind}: use up to 60 lower-case letters, digits "
            "and _, a letter first, for example my_idea. It is not a path."
        )
    if keyword.iskeyword(name) or name == "none":
        raise ConfigError(f"'{name}' is a keyword of Python; choose another name: my_{name}.")


def camel(name: str) -> str:
    """Return ``my_idea`` as ``MyIdea``."""
    return "".join(word.capitalize() for word in name.split("_"))


def program() -> str:
    """Return the command that runs this program in the project folder."""
    return "python src/main.py" if Path("src/main.py").is_file() else "scilab-rl"


def contents_of(name: str, parent: Parent) -> dict[Path, str]:
    """Return the path and content of each new file.

    Raises:
        ConfigError: If one exists, or the parent's source already uses the name.
    """
    test = _TESTS / f"test_{name}.py"
    template = _MODEL_TEST if parent.is_model else _TEST
    return new_files(
        {
            PROJECT_ALGORITHMS / f"{name}.py": source_of(name, parent),
            PROJECT_CONF / "algorithm" / f"{name}.yaml": yaml_of(name, parent),
            test: template.format(name=name, camel=camel(name), path=test),
        }
    )


def new_files(contents: dict[Path, str]) -> dict[Path, str]:
    """Return the path and content of each new file, with the package that the first is in.

    Raises:
        ConfigError: If one of them exists.
    """
    for path in (*contents, next(iter(contents)).with_suffix("")):
        if path.exists():
            raise ConfigError(f"'{path}' already exists; choose another name.")
    package = PROJECT_ALGORITHMS / "__init__.py"
    return contents if package.exists() else {**contents, package: _PACKAGE_DOCSTRING}


def source_of(name: str, parent: Parent) -> str:
    """Return the parent's source with the class renamed, ``sac_var`` to ``SAC_VAR``.

    Raises:
        ConfigError: If the new class would hide something that the parent uses.
    """
    old, new = parent.cls.__name__, name.upper()
    source = renamed(_with_declarations(parent), {old: new, f"Self{old}": f"Self{new}"})
    return f"# A copy of {parent.origin}. Say here what is different.\n{source}"


def renamed(source: str, names: dict[str, str]) -> str:
    """Return Python source with names replaced, also in strings that contain nothing else.

    Raises:
        ConfigError: If the source already uses a new name.
    """
    lines = source.splitlines(keepends=True)
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    taken = {token.string for token in tokens if token.type == tokenize.NAME}
    for new in names.values():
        if new in taken:
            raise ConfigError(f"'{new.lower()}' would hide {new} in the copy; choose another name.")
    words = names | {f'"{old}"': f'"{new}"' for old, new in names.items()}
    for token in reversed(tokens):  # from the end, so that positions stay true
        if token.type in (tokenize.NAME, tokenize.STRING) and token.string in words:
            row, start, stop = token.start[0] - 1, token.start[1], token.end[1]
            lines[row] = lines[row][:start] + words[token.string] + lines[row][stop:]
    return "".join(lines)


def yaml_of(name: str, parent: Parent) -> str:
    """Return the parent's YAML with the new name and class; the values and comments stay."""
    target = f"{PROJECT_ALGORITHMS.name}.{name}.{name.upper()}"
    text = re.sub(r"(?m)^name:.*\n", "", parent.yaml)
    text = re.sub(r"(?m)^_target_:.*$", f"name: {name}\n_target_: {target}", text)
    return f"# {name}, a copy of {parent.name}:\n{text}"


def write_new(contents: dict[Path, str]) -> None:
    """Write all files, or none of them.

    Raises:
        ConfigError: If one cannot be written.
    """
    written: list[Path] = []
    try:
        for path, text in contents.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write_text(path, text)
            written.append(path)
    except OSError as error:
        for path in written:
            path.unlink()
        raise ConfigError(f"'{path}' cannot be written: {error.strerror}.") from error


def _with_declarations(parent: Parent) -> str:
    """Return the source with declarations that Stable-Baselines3's own algorithms do not need."""
    declarations = _action_spaces(parent.cls) + _metrics(parent.cls)
    if not declarations:
        return parent.source
    tree = ast.parse(parent.source)
    body = next(
        node.body
        for node in tree.body
        if isinstance(node, ast.ClassDef) and node.name == parent.cls.__name__
    )
    lines = parent.source.splitlines(keepends=True)
    lines.insert(body[0].end_lineno or 0, f"\n{declarations}")
    return "".join(lines)


def _action_spaces(cls: type) -> str:
    from scilab_rl.learning.compatibility import supported_action_spaces

    known = supported_action_spaces(cls)
    inherited = any(supported_action_spaces(base) for base in cls.__bases__)
    if known is None or inherited or "supported_action_spaces" in vars(cls):
        return ""
    names = ", ".join(f"spaces.{kind.__name__}" for kind in known) + "," * (len(known) == 1)
    return f"    supported_action_spaces = ({names})\n"


def _metrics(cls: type) -> str:
    from scilab_rl.learning.declared import declared_metrics

    inherited = {metric.name for base in cls.__bases__ for metric in declared_metrics(base)}
    known = [metric for metric in declared_metrics(cls) if metric.name not in inherited]
    if not known or "metrics" in vars(cls):
        return ""
    entries = (
        f'("{metric.name}", "{metric.condition}")' if metric.condition else f'"{metric.name}"'
        for metric in known
    )
    lines = "".join(f"        {entry},\n" for entry in entries)
    return f"    metrics = (\n{lines}    )\n"


def _explain(name: str, parent: Parent, paths: list[Path]) -> None:
    """Print the created files and the next steps."""
    algorithm, configuration, test = paths[:3]
    write(f"{algorithm}: class {name.upper()}, a copy of {parent.cls.__name__}; change it here")
    write(f"{configuration}: its parameters")
    write(f"{test}: its contract test, run by: python -m pytest {test}")
    tuned = [o for o in config_files("tuned_values") if o.endswith(f"/{parent.name}")]
    if tuned:
        families = ", ".join(option.rpartition("/")[0] for option in tuned)
        write(
            f"{parent.name} has tuned values for {families}; {name} begins with the defaults. "
            f"Compare it with: algorithm={parent.name} tuned=false"
        )
    write(f"Train it with: {program()} algorithm={name} env={_example_env(parent.cls)}")


def _example_env(cls: type) -> str:
    """Return an environment in which the algorithm can learn."""
    from gymnasium import spaces

    from scilab_rl.learning.compatibility import reads_dictionaries, supported_action_spaces

    goal, vector, discrete = _EXAMPLES
    if stages := getattr(cls, "n_stages", 0):  # a cognitive model
        return "TwoStep" if stages == 2 else "Bandit"
    kinds: tuple[type[spaces.Space], ...] = supported_action_spaces(cls) or (spaces.Box,)
    if spaces.Box not in kinds:
        return discrete
    return goal if reads_dictionaries(cls) else vector
