"""``scilab-rl envs [NAME ...]``: list the environments that this machine can make."""

from __future__ import annotations

import logging

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import print_rows
from scilab_rl.config.workspace import open_project

_log = logging.getLogger(__name__)

_COLUMNS = ("env", "steps", "goal", "action", "observation", "suite", "older")
_SUITE_COLUMNS = ("suite", "installed", "contents", "install", "conflicts", "note")
_OPTIONAL = ("older", "suite", "observation", "steps", "action")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "envs",
        "List the environments, and the packages that they come from: env=NAME trains in one. With "
        "names, make these environments and show their current properties.",
        json=True,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="an id or a part of one")
    parser.add_argument("--suites", action="store_true", help="only the packages")
    options = parser.parse_args(arguments)

    open_project()
    from scilab_rl.envs.catalog import DETAILS, describe, list_all, list_suites

    if options.names:
        rows = [describe(env_id) for env_id in _matching(options.names)]
        print_rows(
            ("env", *DETAILS), rows, optional=_OPTIONAL, if_any=("problem",), as_json=options.json
        )
        return 0
    if not options.suites:
        print_rows(_COLUMNS, list_all(), optional=_OPTIONAL, as_json=options.json)
        _log.info("`scilab-rl envs NAME` makes and shows those whose id contains NAME.")
        _log.info("`scilab-rl envs --suites` lists more packages, and conflicts.")
        for suite in list_suites():
            if not suite["installed"]:
                _log.info(
                    "Not installed: %s. Install it with: %s", suite["suite"], suite["install"]
                )
        return 0
    print_rows(_SUITE_COLUMNS, list_suites(), as_json=options.json)
    return 0


def _matching(names: list[str]) -> list[str]:
    """Return the ids that names select: a part of a name selects all newest ids that contain it.

    Raises:
        ConfigError: If a name matches none.
    """
    from scilab_rl.envs.registration import known_env_ids, resolve_env_id, versions_by_family

    newest = [versions[-1] for versions in versions_by_family(known_env_ids()).values()]
    matching: list[str] = []
    for name in names:
        found = [env_id for env_id in newest if name.lower() in env_id.lower()]
        if not found:
            env_id, notice = resolve_env_id(name)
            found = [env_id]
            if notice:
                _log.info(notice)
        matching += found
    return list(dict.fromkeys(matching))
