"""The folders of studies, and training with what one has found. Imports nothing heavy."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scilab_rl.errors import ConfigError, did_you_mean, listing

STUDIES = "studies"
DATABASE, DEFINITION_FILE, STOP_FILE = "study.db", "study.yaml", "delete_me_to_stop"
REPORT, TABLE, TUNED_FILE, WINNER_FILE = "report.html", "settings.csv", "winner.yaml", "winner.json"
_BEST_OF = ("+best_of=", "best_of=", "--best-of=")


def study_names(base: Path) -> list[str]:
    """Return the names of the studies below the folder of all runs."""
    return sorted(path.parent.name for path in (base / STUDIES).glob(f"*/{DEFINITION_FILE}"))


def find_study(name: str, base: Path) -> Path:
    """Return the folder of a study.

    Raises:
        ConfigError: If there is none of this name.
    """
    names = study_names(base)
    if name not in names:
        raise ConfigError(
            f"There is no study '{name}' in '{base / STUDIES}'.{did_you_mean(name, names)} "
            f"There are: {listing(names) or 'none'}."
        )
    return base / STUDIES / name


def expand_best_of(arguments: Sequence[str]) -> list[str]:
    """Replace ``+best_of=STUDY`` by the study's overrides and those of its winner.

    What the user types beside it wins.

    Raises:
        ConfigError: If the study does not exist or has no winner.
    """
    arguments = list(arguments)
    if "--best-of" in arguments[:-1]:
        at = arguments.index("--best-of")
        arguments[at : at + 2] = [f"--best-of={arguments[at + 1]}"]
    names = [a.partition("=")[2] for a in arguments if a.startswith(_BEST_OF)]
    if not names:
        return arguments
    typed = [a for a in arguments if not a.startswith(_BEST_OF)]
    base = next((a.partition("=")[2] for a in typed if _key(a) == "base_logdir"), "data")
    found = winner_overrides(find_study(names[-1], Path(base)))
    keys = {_key(a) for a in typed}
    return [*(override for override in found if _key(override) not in keys), *typed]


def winner_overrides(directory: Path) -> list[str]:
    """Return the overrides that train with the winner of a study.

    Raises:
        ConfigError: If it has none, or if its file was changed to bring code with it.
    """
    try:
        stored: Any = json.loads((directory / WINNER_FILE).read_text(encoding="utf-8"))
        overrides = [str(override) for override in stored["overrides"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"The study {directory.name} has no winner yet; `scilab-rl study {directory.name}` "
            "shows how far it is."
        ) from error
    for override in overrides:
        if "_target_" in override or "${" in override:
            raise ConfigError(f"'{directory / WINNER_FILE}' holds {override!r}, which is no value.")
    return overrides


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]
