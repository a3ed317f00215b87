"""``scilab-rl envs [NAME ...]``: the environments that this machine can make."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import print_json, print_rows
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)

_COLUMNS = ("env", "steps", "goal", "action", "observation", "suite", "older")
_DETAILS = ("env", "observation", "action", "goal", "steps", "problem")
_SUITE_COLUMNS = ("suite", "installed", "brings", "install", "conflicts", "note")
_OPTIONAL = ("older", "suite", "observation", "steps", "action")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "envs",
        "List the environments, and the packages that they come from: env=NAME trains in one. With "
        "names, make these environments and show them as they are now.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="an id or a part of one")
    parser.add_argument("--suites", action="store_true", help="only the packages")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)

    open_desk()
    if options.names:
        rows = [describe(env_id) for env_id in _fitting(options.names)]
        shown = [c for c in _DETAILS if c != "problem" or any(row["problem"] for row in rows)]
        _print(shown, rows, as_json=options.json)
        return 0
    if not options.suites:
        _print(_COLUMNS, list_all(), as_json=options.json)
        _log.info("`scilab-rl envs NAME` makes and shows those whose id contains NAME.")
        _log.info("`scilab-rl envs --suites` tells how to install more, and what conflicts.")
        for suite in list_suites():
            if not suite["installed"]:
                _log.info(
                    "Not installed: %s. Install it with: %s", suite["suite"], suite["install"]
                )
        return 0
    _print(_SUITE_COLUMNS, list_suites(), as_json=options.json)
    return 0


def _print(columns: Sequence[str], rows: list[dict[str, Any]], *, as_json: bool) -> None:
    if as_json:
        print_json(rows)
    else:
        print_rows(columns, rows, optional=[name for name in _OPTIONAL if name in columns])


def list_suites() -> list[dict[str, Any]]:
    """Return the packages with environments: whether they are there, how to get them, and traps."""
    from scilab_rl.envs.suites import SUITES

    return [
        {
            "suite": suite.package,
            "installed": suite.installed,
            "brings": suite.brings,
            "install": suite.install_line or None,
            "conflicts": suite.conflicts or None,
            "note": suite.note or None,
        }
        for suite in SUITES
    ]


def list_all() -> list[dict[str, Any]]:
    """Return the newest usable version of each environment; none is made, so this is quick.

    Returns:
        For each the id, the step limit (None: none), the package, the older usable ids, and, as
        recorded with the pinned versions, its spaces and whether it has goals.
    """
    import gymnasium as gym

    from scilab_rl.envs.recorded import spaces_of
    from scilab_rl.envs.registration import known_env_ids, module_of, suite_of, versions_by_family

    rows = []
    for versions in versions_by_family(known_env_ids()).values():
        spec = gym.registry[versions[-1]]
        suite = suite_of(spec)
        name = suite.package if suite else module_of(spec).partition(".")[0]
        row = {"env": spec.id, "steps": spec.max_episode_steps, **spaces_of(spec.id)}
        rows.append(row | {"suite": name, "older": versions[:-1]})
    return rows


def describe(env_id: str) -> dict[str, Any]:
    """Make an environment and return its spaces, step limit, and whether it has goals."""
    import gymnasium as gym

    from scilab_rl.algorithms.compatibility import is_goal_space

    row: dict[str, Any] = {"env": env_id, **dict.fromkeys(_DETAILS[1:])}
    try:
        env = gym.make(env_id)
    except Exception as error:  # noqa: BLE001 - one that cannot be made is listed with the reason
        return row | {"problem": f"{type(error).__name__}: {error}"}
    row |= {
        "observation": space_text(env.observation_space),
        "action": space_text(env.action_space),
        "goal": is_goal_space(env.observation_space),
        "steps": env.spec.max_episode_steps if env.spec else None,
    }
    env.close()
    return row


def space_text(space: Any) -> str:
    """Return a short description of a space.

    >>> from gymnasium.spaces import Box, Dict
    >>> space_text(Dict(goal=Box(-1, 1, (3,)), observation=Box(-float("inf"), float("inf"), (10,))))
    'goal: Box(3) from -1 to 1, observation: Box(10)'
    """
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        return ", ".join(f"{key}: {space_text(entry)}" for key, entry in space.spaces.items())
    if not isinstance(space, spaces.Box):
        return str(space)
    has_bounds = space.is_bounded() and space.low.size > 0
    bounds = f" from {space.low.min():g} to {space.high.max():g}" if has_bounds else ""
    return f"Box({', '.join(map(str, space.shape))}){bounds}"


def _fitting(names: list[str]) -> list[str]:
    """Return the ids that are meant: a part of a name means all newest ids that contain it.

    Raises:
        ConfigError: If nothing fits.
    """
    from scilab_rl.envs.registration import known_env_ids, resolve_env_id, versions_by_family

    newest = [versions[-1] for versions in versions_by_family(known_env_ids()).values()]
    fitting: list[str] = []
    for name in names:
        found = [env_id for env_id in newest if name.lower() in env_id.lower()]
        if not found:
            env_id, notice = resolve_env_id(name)
            found = [env_id]
            if notice:
                _log.info(notice)
        fitting += found
    return list(dict.fromkeys(fitting))
