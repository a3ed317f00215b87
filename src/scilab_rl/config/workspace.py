"""The project folder: where a researcher keeps her YAML, algorithms, environments and agents."""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from scilab_rl.errors import ConfigError

SHIPPED_CONF = Path(__file__).parents[1] / "conf"
SHIPPED_AGENTS = Path(__file__).resolve().parents[1] / "agents"
PROJECT_CONF = Path("conf")
PROJECT_AGENTS = Path("agents")
PROJECT_ALGORITHMS = Path("src/custom_algorithms")
PROJECT_ENVS = "custom_envs"


def open_project() -> None:
    """Make the project in the current folder importable and let it register its environments.

    Raises:
        ConfigError: If a project file hides behind a shipped one, or ``custom_envs`` is
            broken.
    """
    source = str(Path("src").resolve())
    if Path(source).is_dir() and source not in sys.path:
        sys.path.insert(0, source)
    refuse_duplicates()
    if importlib.util.find_spec(PROJECT_ENVS) is not None:
        try:
            importlib.import_module(PROJECT_ENVS)
        except Exception as error:
            raise ConfigError(
                f"src/custom_envs cannot be imported: {type(error).__name__}: {error}"
            ) from error


def refuse_duplicates() -> None:
    """Reject a project file with the name of a shipped one, which Hydra would silently ignore.

    Raises:
        ConfigError: With the name of the file.
    """
    for path in sorted(PROJECT_CONF.rglob("*.yaml")):
        name = path.relative_to(PROJECT_CONF)
        if (SHIPPED_CONF / name).is_file():
            raise ConfigError(
                f"'{path}' has the name of a file that Scilab-RL ships, so it would be ignored. "
                f"Rename it, for example to '{path.with_stem('my_' + path.stem)}'."
            )


def config_files(group: str) -> dict[str, Path]:
    """Return the option names of a configuration group and their files, shipped and project folder.

    Args:
        group: For example ``algorithm`` or ``performance``; sub-folders become ``folder/name``.
    """
    options = {}
    for root in (SHIPPED_CONF / group, PROJECT_CONF / group):
        for path in sorted(root.rglob("*.yaml")):
            options[path.relative_to(root).with_suffix("").as_posix()] = path
    return options


def tuned_option(values: Mapping[str, object]) -> str | None:
    """Return the option of the group ``tuned_values`` that fits, such as ``FetchReach/sac``."""
    env, algorithm = values.get("env"), values.get("algorithm")
    if not values.get("tuned") or not isinstance(env, str) or not isinstance(algorithm, dict):
        return None
    family = re.sub(r"-v\d+$", "", env)
    option = f"{family}/{algorithm.get('name')}"
    return option if option in config_files("tuned_values") else None
