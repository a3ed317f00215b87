"""``scilab-rl envs [NAME ...]``: the environments that this machine can make."""

from __future__ import annotations

import importlib.util
import logging
from typing import Any

from scilab_rl.commands.parser import CommandParser
from scilab_rl.commands.tables import print_json, print_rows
from scilab_rl.workspace import open_desk

_log = logging.getLogger(__name__)

_COLUMNS = ("env", "steps", "suite", "older")
_DETAILS = ("env", "observation", "action", "goal", "steps", "problem")
_OPTIONAL = ("older", "suite", "steps")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "envs",
        "List the environments and their step limits: env=NAME trains in one. With names, make "
        "these environments and show their spaces and whether they have goals.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="an id or a part of one")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)

    open_desk()
    if options.names:
        rows = [describe(env_id) for env_id in _fitting(options.names)]
        columns = [c for c in _DETAILS if c != "problem" or any(row["problem"] for row in rows)]
    else:
        rows, columns = list_all(), list(_COLUMNS)
    if options.json:
        print_json(rows)
        return 0
    print_rows(columns, rows, optional=[c for c in _OPTIONAL if c in columns])
    if not options.names:
        _log.info("`scilab-rl envs NAME` shows the spaces of those whose id contains NAME.")
        for package, install in missing_suites().items():
            _log.info("Not installed: %s. Install it with: %s", package, install)
    return 0


def list_all() -> list[dict[str, Any]]:
    """Return the newest usable version of each environment; none is made, so this is quick.

    Returns:
        For each the id, the step limit (None: none), the package, and the older usable ids.
    """
    import gymnasium as gym

    from scilab_rl.envs.registration import known_env_ids, versions_by_family

    rows = []
    for versions in versions_by_family(known_env_ids()).values():
        spec = gym.registry[versions[-1]]
        row = {"env": spec.id, "steps": spec.max_episode_steps, "suite": _package(spec.entry_point)}
        rows.append(row | {"older": versions[:-1]})
    return rows


def missing_suites() -> dict[str, str]:
    """Return the packages with environments that are not installed, and how to install each."""
    from scilab_rl.envs.registration import SUITES

    return {
        package: f'pip install "scilab-rl[{extra}]"'
        for package, (extra, _) in SUITES.items()
        if importlib.util.find_spec(package) is None
    }


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


def _package(entry_point: Any) -> str:
    """Return the package that an environment comes from."""
    module = entry_point if isinstance(entry_point, str) else getattr(entry_point, "__module__", "")
    return module.partition(":")[0].partition(".")[0]
