"""Configurations of earlier runs, which are data: they must not contain code."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

import hydra.utils
import yaml
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from scilab_rl.config.classes import class_name, missing_package
from scilab_rl.config.compose import explain_error, friendly_override, to_plain
from scilab_rl.config.overrides import read_changes
from scilab_rl.config.schema import RunConfig, Values
from scilab_rl.errors import ConfigError

# In the environment, so that the worker processes of a study read it too.
TRUST_VARIABLE = "SCILAB_RL_TRUST_MODULES"
_TRUSTED = (
    "scilab_rl.", "custom_algorithms.", "custom_envs.", "custom_probes.",
    "stable_baselines3.", "sb3_contrib.", "gymnasium.", "gymnasium_robotics.", "torch.nn.",
    "torch.optim.",
)  # fmt: skip
_WORDS = ("auto", "her", "hydra.utils.get_class")
# As in env=module:Id-v0. The module is imported before the environment is made.
_WITH_MODULE = re.compile(r"(?P<module>[^:]*):.*", re.DOTALL)
_ENV_ID = re.compile(r"[\w.]+:[\w./-]+-v\d+")


def refuse_untrusted_code(cfg: object, path: Path) -> None:
    """Reject interpolations, and classes outside the framework, its libraries and the project.

    Args:
        cfg: Plain dictionaries and lists.
        path: The file that they are from.

    Raises:
        ConfigError: With the name that is refused.
    """
    for key, value in _entries("", cfg):
        if isinstance(value, str) and "${" in value:
            raise ConfigError(
                f"'{path}' holds the interpolation {value!r}; recorded runs hold values."
            )
        name = value if key in ("_target_", "path") else class_name(key, value)
        if isinstance(name, str):
            _refuse_untrusted_class(name, path)


def refuse_untrusted_modules(cfg: Values, path: Path, typed_env: str = "") -> None:
    """Reject environments whose id would import a module that the user has not chosen.

    A module may be imported when it belongs to the framework, its libraries or the project folder,
    when an installed plug-in of Gymnasium registers environments with it, when it is imported
    already, when the user has typed the same id, or has named the module with ``--trust-module``.

    Args:
        cfg: Plain dictionaries and lists.
        path: The file that they are from.
        typed_env: The environment of the user's own command line.

    Raises:
        ConfigError: With the flag that is missing.
    """
    ids = [cfg.get("env")]
    ids += [v for _, v in _entries("", cfg.get("env_kwargs")) if _ENV_ID.fullmatch(str(v))]
    for env_id in ids:
        module = _module_of(env_id)
        if module and env_id != typed_env and not _is_chosen(module):
            raise ConfigError(
                f"'{path}' names the environment '{env_id}', for which the module '{module}' would "
                "be imported, and neither your project nor an installed plug-in registers it. A "
                f"recorded run is data: if you trust this module, add --trust-module={module}."
            )


def _module_of(env_id: object) -> str:
    match = _WITH_MODULE.fullmatch(env_id) if isinstance(env_id, str) else None
    return match["module"] if match else ""


def _is_chosen(module: str) -> bool:
    if module in sys.modules or module in os.environ.get(TRUST_VARIABLE, "").split(","):
        return True
    plug_ins = {point.module for point in metadata.entry_points(group="gymnasium.envs")}
    return f"{module}.".startswith(_TRUSTED) or module in plug_ins


def _entries(key: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield each value with the key that it stands under, and so those inside of it."""
    yield key, value
    if isinstance(value, Mapping):
        for name, entry in value.items():
            yield from _entries(str(name), entry)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from _entries(key, entry)


def _refuse_untrusted_class(target: str, path: Path) -> None:
    if target in _WORDS:
        return
    if target.startswith(_TRUSTED):
        try:
            found = hydra.utils.get_class(target)
        except Exception as error:
            unknown = ConfigError(f"'{path}' names '{target}', which cannot be found.")
            raise (missing_package(error, target) or unknown) from error
        if found.__module__.startswith(_TRUSTED):
            return
    raise ConfigError(
        f"'{path}' names '{target}', which does not belong to Scilab-RL, its libraries or your "
        "project. A recorded run is data and must not contain code."
    )


def load_recorded(
    path: Path,
    overrides: Sequence[str] = (),
    *,
    makes_env: bool = True,
    typed_env: str = "",
) -> RunConfig:
    """Load the configuration of an earlier run, which is data: it may not name untrusted code.

    Args:
        path: A ``config.yaml`` that a run has written.
        overrides: ``key=value`` changes by the user.
        makes_env: Whether its environment is going to be made.
        typed_env: The environment of the user's own command line, if it names one.

    Raises:
        ConfigError: If it cannot be read, or names anything but algorithms, environments and
            wrappers of the framework, its libraries and the project folder.
    """
    try:
        loaded = OmegaConf.load(path)
        assert isinstance(loaded, DictConfig)
        stored = to_plain(loaded, resolve=False)
        refuse_untrusted_code(stored, path)
        if makes_env:
            refuse_untrusted_modules(stored, path, typed_env)
        # Newer keys get their default; others may look only where the user says so.
        given = {key: value for key, value in stored.items() if key != "viewer_host"}
        cfg = OmegaConf.create(RunConfig().values() | given)
        for key, value in read_changes([friendly_override(word) for word in overrides]):
            OmegaConf.update(cfg, key, value)
        return RunConfig.from_values(to_plain(cfg))
    except _UNREADABLE as error:
        raise explain_error(error) from error


def as_yaml(values: Values) -> str:
    """Return values as YAML in which they keep their types when they are read back."""
    return OmegaConf.to_yaml(OmegaConf.create(dict(values)))


_UNREADABLE = (
    OSError, AssertionError, ValueError, OmegaConfBaseException, OverrideParseException,
    yaml.YAMLError,
)  # fmt: skip
