"""The folders of studies, and training with what one has found. Imports nothing heavy."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scilab_rl.errors import ConfigError, did_you_mean, listing

STUDIES = "studies"
DATABASE, DEFINITION_FILE, STOP_FILE = "study.db", "study.yaml", "STOP"
REPORT, TABLE, TUNED_FILE, WINNER_FILE = (
    "report.html",
    "configurations.csv",
    "winner.yaml",
    "winner.json",
)
_PLACES = ("base_logdir", "restore_policy", "info")
_BEST_OF = ("+from_study=", "from_study=", "--best-of=")


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


def expand_from_study(arguments: Sequence[str]) -> list[str]:
    """Replace ``+from_study=STUDY`` by the study's overrides and those of its winner.

    Overrides of the command line win.

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
    from_file = any(override.startswith("+performance=") for override in found)
    if from_file and not {"--multirun", "-m"} & {*typed}:
        found.append("hydra/launcher=local")  # the file may choose a cluster
    keys = {_key(a) for a in typed}
    return [*(override for override in found if _key(override) not in keys), *typed]


def winner_overrides(directory: Path) -> list[str]:
    """Return the overrides that train with the winner of a study.

    Raises:
        ConfigError: If it has none, or if its file was changed to contain code.
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
        _refuse_untrusted_override(override, directory / WINNER_FILE)
    return overrides


def _refuse_untrusted_override(override: str, path: Path) -> None:
    """Reject what is more than a value of a run: flags of Hydra, files elsewhere, code."""
    from hydra.errors import OverrideParseException

    from scilab_rl.config.overrides import read_changes
    from scilab_rl.config.recorded import refuse_untrusted_code, refuse_untrusted_modules

    refusal = ConfigError(f"'{path}' holds {override!r}, which is not a value.")
    if re.match(r"-|[+~]*hydra\b", override) or "_target_" in override:
        raise refusal
    try:
        for key, value in read_changes([] if override.startswith("~") else [override]):
            if key not in _PLACES and ".." in str(value):  # a file of another folder
                raise refusal
            stored = {key.rpartition(".")[2]: value}
            refuse_untrusted_code(stored, path)
            refuse_untrusted_modules(stored, path)
    except OverrideParseException as error:
        raise refusal from error


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]
