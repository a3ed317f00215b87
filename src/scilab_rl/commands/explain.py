"""``scilab-rl explain KEY ... [KEY=VALUE ...]``: which layer and file set the value of a key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import OmegaConf

from scilab_rl import config
from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import as_typed, print_json, print_rows
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.workspace import SHIPPED_CONF, config_files, open_desk

_LAYER_NAMES = {"tuned_values": "tuned values", "performance": "experiment"}
_COLUMNS = ("key", "value", "state", "layer", "source")
_ABSENT = object()


@dataclass(frozen=True)
class Layer:
    """One file or one word of the command line that sets keys.

    Attributes:
        name: What kind of layer it is, for people.
        source: The file, or what was typed.
        values: What it sets, nested like the configuration, interpolations as they are written.
    """

    name: str
    source: str
    values: Mapping[str, Any]

    def lookup(self, key: str) -> Any:
        """Return the value of a dotted key, or ``_ABSENT`` when this layer does not set it."""
        value: Any = self.values
        for part in key.split("."):
            if not isinstance(value, Mapping) or part not in value:
                return _ABSENT
            value = value[part]
        return value


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser("explain", "Show which layer and file set the value of a key.")
    parser.add_argument(
        "words",
        nargs="+",
        metavar="KEY",
        help="a key such as algorithm.gamma, or a group of them such as algorithm; "
        "with KEY=VALUE: as if this were on the command line",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)

    keys = [word for word in options.words if not _is_override(word)]
    overrides = [config.friendly_override(word) for word in options.words if _is_override(word)]
    if not keys:
        raise ConfigError("Which key? For example: scilab-rl explain algorithm.gamma env=FetchPush")
    open_desk()
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        rows = explain(keys, overrides)
    if options.json:
        print_json(rows)
    else:
        print_rows(_COLUMNS, [row | {"value": as_typed(row["value"])} for row in rows])
    return 0


def explain(keys: Sequence[str], overrides: Sequence[str]) -> list[dict[str, Any]]:
    """Return where the values of keys come from. Must run inside ``hydra.initialize...``.

    Args:
        keys: Dotted keys, or groups of them, which stand for all keys below.
        overrides: The command line.

    Returns:
        For each key its final value and then those that it replaced, the newest first.

    Raises:
        ConfigError: If there is no such key, or the configuration cannot be composed.
    """
    cfg = config.compose(overrides)
    config.check_keys(cfg)
    final = config.flat(cfg)
    tuned = config.tuned_option(cfg)
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


def _leaves(key: str, final: Mapping[str, Any]) -> list[str]:
    """Return the key, or the keys below it."""
    leaves = [leaf for leaf in final if leaf == key or leaf.startswith(f"{key}.")]
    if not leaves:
        raise ConfigError(
            f"There is no key '{key}'.{did_you_mean(key, final)} `scilab-rl explain algorithm` "
            "shows the algorithm's keys, `scilab-rl --help` all others."
        )
    return leaves


def _rows(key: str, final: Any, layers: Sequence[Layer]) -> Iterator[dict[str, Any]]:
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
        values = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        yield Layer(_LAYER_NAMES.get(group, group), _near(path), _nested(part.package, values))


def _typed_layers(overrides: Sequence[str]) -> Iterator[Layer]:
    """Yield what the command line sets; the choice of a file is not a value."""
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        if not override.is_delete() and not config_files(override.key_or_group):
            values = _nested(override.key_or_group, override.value())
            yield Layer("command line", str(override.input_line), values)


def _nested(package: str, values: Any) -> Any:
    """Return the values below the dotted path of their package."""
    for part in reversed(package.split(".") if package else []):
        values = {part: values}
    return values


def _near(path: Path) -> str:
    """Return a path as seen from here, where that is shorter."""
    resolved = path.resolve()
    return str(
        resolved.relative_to(Path.cwd()) if resolved.is_relative_to(Path.cwd()) else resolved
    )
