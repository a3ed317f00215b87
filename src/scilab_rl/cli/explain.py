"""``scilab-rl explain KEY ... [KEY=VALUE ...]``: show which layer and file set a key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import as_typed, print_json, print_rows
from scilab_rl.config.compose import (
    compose_values,
    friendly_override,
    initialized_hydra,
    read_yaml,
)
from scilab_rl.config.schema import RunConfig, flatten
from scilab_rl.config.workspace import SHIPPED_CONF, config_files, open_project, tuned_option
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.files import shown

_LAYER_NAMES = {"tuned_values": "tuned values", "performance": "experiment"}
_COLUMNS = ("key", "value", "state", "layer", "source")
_ABSENT = object()


@dataclass(frozen=True)
class Layer:
    """One file or one word of the command line that sets keys.

    Attributes:
        name: The kind of layer.
        source: The file, or the word.
        values: Its keys, nested as in the configuration, with interpolations as written.
    """

    name: str
    source: str
    values: Mapping[str, object]

    def lookup(self, key: str) -> object:
        """Return the value of a dotted key, or ``_ABSENT`` if this layer does not set it."""
        value: object = self.values
        for part in key.split("."):
            if not isinstance(value, Mapping) or part not in value:
                return _ABSENT
            value = value[part]
        return value


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "explain", "Show which layer and file set the value of a key.", json=True
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="KEY",
        help="a key such as algorithm.gamma, or a group of them such as algorithm; "
        "with KEY=VALUE: as if this were on the command line",
    )
    options = parser.parse_args(arguments)

    keys = [word for word in options.words if not _is_override(word)]
    overrides = [friendly_override(word) for word in options.words if _is_override(word)]
    if not keys:
        raise ConfigError("Which key? For example: scilab-rl explain algorithm.gamma env=FetchPush")
    open_project()
    with initialized_hydra():
        rows = explain(keys, overrides)
    if options.json:
        print_json(rows)
    else:
        print_rows(_COLUMNS, [row | {"value": as_typed(row["value"])} for row in rows])
    return 0


def explain(keys: Sequence[str], overrides: Sequence[str]) -> list[dict[str, object]]:
    """Return where the values of keys come from. Must run inside `initialized_hydra`.

    Args:
        keys: Dotted keys, or groups of them, which stand for all keys below.
        overrides: The command line.

    Returns:
        For each key its final value and then those that it replaced, the newest first.

    Raises:
        ConfigError: If there is no such key, or the configuration cannot be composed.
    """
    values = compose_values(overrides)
    RunConfig.from_values(values)
    final = dict(flatten(values))
    tuned = tuned_option(values)
    extra = [] if tuned is None else [f"+tuned_values={tuned}"]
    layers = [*_file_layers([*extra, *overrides]), *_typed_layers(overrides)]
    return [
        row
        for key in keys
        for leaf in _leaves(key, final)
        for row in _rows(leaf, final[leaf], layers)
    ]


def _is_override(word: str) -> bool:
    return "=" in word or word.startswith("~")


def _leaves(key: str, final: Mapping[str, object]) -> list[str]:
    """Return the key, or the keys below it."""
    leaves = [leaf for leaf in final if leaf == key or leaf.startswith(f"{key}.")]
    if not leaves:
        raise ConfigError(
            f"There is no key '{key}'.{did_you_mean(key, final)} `scilab-rl explain algorithm` "
            "shows the algorithm's keys, `scilab-rl --help all` all others."
        )
    return leaves


def _rows(key: str, final: object, layers: Sequence[Layer]) -> Iterator[dict[str, object]]:
    state = "final"
    for layer in reversed(layers):
        value = layer.lookup(key)
        if value is _ABSENT:
            continue
        source = layer.source
        if state == "final":
            if isinstance(value, str) and "${" in value:
                source += f" as {value}"
            value = final
        yield {"key": key, "value": value, "state": state, "layer": layer.name, "source": source}
        state = "before"


def _file_layers(overrides: Sequence[str]) -> Iterator[Layer]:
    """Yield the files that Hydra composes, in the order in which it merges them."""
    loader = GlobalHydra.instance().config_loader()
    composed = loader.compute_defaults_list("main", list(overrides), RunMode.RUN)
    for part in composed.defaults:
        group, _, option = part.config_path.partition("/")
        if group == "hydra":
            continue
        path = config_files(group)[option] if option else SHIPPED_CONF / f"{group}.yaml"
        path_of_keys = part.package.split(".") if part.package else []
        values = _nested(path_of_keys, read_yaml(path))
        yield Layer(_LAYER_NAMES.get(group, group), shown(path), values)


def _typed_layers(overrides: Sequence[str]) -> Iterator[Layer]:
    """Yield the values that the command line sets; the choice of a file is not a value."""
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        if not override.is_delete() and not config_files(override.key_or_group):
            *path, name = override.key_or_group.split(".")
            values = _nested(path, {name: override.value()})
            yield Layer("command line", str(override.input_line), values)


def _nested(path: Sequence[str], values: Mapping[str, object]) -> Mapping[str, object]:
    """Return the values below a path of keys."""
    for part in reversed(path):
        values = {part: values}
    return values
