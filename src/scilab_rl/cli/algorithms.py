"""``scilab-rl algorithms``: list the algorithms of framework and project folder."""

from __future__ import annotations

from pathlib import Path

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_rows
from scilab_rl.config.compose import compose
from scilab_rl.config.schema import AlgorithmConfig
from scilab_rl.config.workspace import SHIPPED_CONF, config_files, open_project

_COLUMNS = ("algorithm", "actions", "hindsight", "where", "class", "description", "problem")
_OPTIONAL = ("class", "where", "hindsight", "actions")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "algorithms",
        "List the algorithms: algorithm=NAME trains with one. Hindsight: whether episodes are "
        "relabeled with the goals they reached, if the environment has goals.",
        json=True,
    )
    options = parser.parse_args(arguments)

    open_project()
    rows = describe_all()
    print_rows(_COLUMNS, rows, optional=_OPTIONAL, if_any=("problem",), as_json=options.json)
    return 0


def describe_all() -> list[dict[str, object]]:
    """Return a description of each algorithm; the project folder must be open.

    Returns:
        For each YAML its name, class, place (shipped or project), action spaces, hindsight replay
        (yes, off or no), description, and the problem that keeps it from being used, if any.
    """
    return [_describe(name, path) for name, path in config_files("algorithm").items()]


def _describe(name: str, path: Path) -> dict[str, object]:
    from scilab_rl.learning.compatibility import supported_action_spaces
    from scilab_rl.run.checks import algorithm_class

    row: dict[str, object] = {
        "algorithm": name,
        "class": None,
        "where": "shipped" if path.is_relative_to(SHIPPED_CONF) else "project",
        "actions": None,
        "hindsight": None,
        "description": _first_comment(path),
        "problem": None,
    }
    try:
        cfg = compose([f"algorithm={name}", "tuned=false"])
        row["class"] = cfg.algorithm.target
        cls = algorithm_class(cfg)
        row["actions"] = [space.__name__ for space in supported_action_spaces(cls) or ()]
        row["hindsight"] = _hindsight(cls, cfg.algorithm)
    except Exception as error:  # noqa: BLE001 - a file of the project may raise anything
        row["problem"] = f"{type(error).__name__}: {error}"
    return row


def _hindsight(cls: type, algorithm: AlgorithmConfig) -> str:
    """Return whether an algorithm relabels: yes, off (it could), or no (no replay buffer)."""
    from scilab_rl.learning.compatibility import reads_dictionaries

    if getattr(cls, "learns_offline", False):
        return "yes"
    if not reads_dictionaries(cls) or "replay_buffer_class" not in algorithm.arguments:
        return "no"
    return "off" if algorithm.arguments["replay_buffer_class"] is None else "yes"


def _first_comment(path: Path) -> str | None:
    """Return the text of the first line, when it is a comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        line = file.readline()
    return line.lstrip("# ").strip() if line.startswith("#") else None
