"""``scilab-rl algorithms``: what can learn, from the YAML files of framework and desk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra

from scilab_rl import config
from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import print_json, print_rows
from scilab_rl.workspace import SHIPPED_CONF, config_files, open_desk

_COLUMNS = ("algorithm", "actions", "hindsight", "where", "class", "description", "problem")
_OPTIONAL = ("class", "where", "hindsight", "actions")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "algorithms",
        "List the algorithms: algorithm=NAME trains with one. Hindsight: whether episodes are "
        "relabelled with the goals they reached, where the environment has goals.",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)

    open_desk()
    rows = describe_all()
    if options.json:
        print_json(rows)
    else:
        columns = [c for c in _COLUMNS if c != "problem" or any(row["problem"] for row in rows)]
        print_rows(columns, rows, optional=_OPTIONAL)
    return 0


def describe_all() -> list[dict[str, Any]]:
    """Return what is known about each algorithm; the desk must be open.

    Returns:
        For each YAML its name, class, place (shipped or desk), action spaces, hindsight replay
        (yes, off or no), description, and the problem that keeps it from being used, if any.
    """
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        return [_describe(name, path) for name, path in config_files("algorithm").items()]


def _describe(name: str, path: Path) -> dict[str, Any]:
    from scilab_rl import assembly
    from scilab_rl.algorithms.compatibility import reads_dictionaries, supported_action_spaces

    row: dict[str, Any] = {
        "algorithm": name,
        "class": None,
        "where": "shipped" if path.is_relative_to(SHIPPED_CONF) else "desk",
        "actions": None,
        "hindsight": None,
        "description": _first_comment(path),
        "problem": None,
    }
    try:
        cfg = config.compose([f"algorithm={name}", "tuned=false"])
        config.check_keys(cfg)
        row["class"] = cfg.algorithm._target_
        cls = assembly.algorithm_class(cfg)
        row["actions"] = [space.__name__ for space in supported_action_spaces(cls) or ()]
        row["hindsight"] = _hindsight(cfg.algorithm) if reads_dictionaries(cls) else "no"
    except Exception as error:  # noqa: BLE001 - whatever a desk file raises, the list goes on
        row["problem"] = f"{type(error).__name__}: {error}"
    return row


def _hindsight(algorithm: Any) -> str:
    """Tell whether an algorithm relabels: yes, off (it could), or no (it has no replay buffer)."""
    if "replay_buffer_class" not in algorithm:
        return "no"
    return "off" if algorithm.replay_buffer_class is None else "yes"


def _first_comment(path: Path) -> str | None:
    """Return the text of the first line, when it is a comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        line = file.readline()
    return line.lstrip("# ").strip() if line.startswith("#") else None
