"""The composition of a configuration from its layers.

Layers, later ones win: main, algorithm, tuned values for algorithm and environment, experiment file
(``+performance=``), command line.
"""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from scilab_rl.config.overrides import as_text, as_texts, tuple_as_list
from scilab_rl.config.schema import ALIASES, KEYS, STRING, RunConfig, Values, unknown_key
from scilab_rl.config.workspace import SHIPPED_CONF, config_files, tuned_option
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.files import shown

_log = logging.getLogger(__name__)
# Keys whose values are text, which Hydra may need in quotes; commas in prose separate no values.
_TEXTS = {key.name for key in KEYS if key.kind == STRING} | {
    f"hydra.sweeper.{name}" for name in ("study_name", "storage")
}
_TEXT_LISTS = ("tags", "render_metrics_train", "render_metrics_test")
_PROSE = ("info", "record_when")
# Parts of the configuration that are dictionaries: their keys can be added without Hydra's plus.
_OPEN_GROUPS = ("algorithm.", "env_kwargs.")


def compose(overrides: Sequence[str], composed: DictConfig | None = None) -> RunConfig:
    """Compose the configuration for these overrides, with tuned values where they apply.

    Args:
        overrides: As typed; see `friendly_override`.
        composed: What Hydra has composed from them already, without tuned values.

    Raises:
        ConfigError: If it cannot be composed, a key is unknown or a value is invalid.
    """
    return RunConfig.from_values(compose_values(overrides, composed))


def compose_values(overrides: Sequence[str], composed: DictConfig | None = None) -> Values:
    """Compose the values of all keys as YAML has them; see `compose`."""
    overrides = [friendly_override(override) for override in overrides]
    values = _plain(overrides, composed)
    tuned = tuned_option(values)
    if tuned is None:
        return values
    RunConfig.from_values(values)  # errors before notices
    path = config_files("tuned_values")[tuned]
    _log.log(
        # The line that begins a run names shipped values, too; those of a project may be forgotten.
        logging.DEBUG if path.is_relative_to(SHIPPED_CONF) else logging.INFO,
        "Tuned values for %s are used: %s (off with tuned=false).",
        tuned.replace("/", " with "),
        shown(path),
    )
    return _plain([f"+tuned_values={tuned}", *overrides])


def compose_launcher(overrides: Sequence[str]) -> Values:
    """Compose the mapping ``hydra.launcher``, which says where runs are trained."""
    return _plain([friendly_override(word) for word in overrides], group="hydra.launcher")


def _plain(overrides: list[str], composed: DictConfig | None = None, *, group: str = "") -> Values:
    try:
        if composed is None:
            with initialized_hydra():
                composed = hydra.compose(
                    "main", overrides=overrides, return_hydra_config=bool(group)
                )
        return to_plain(OmegaConf.select(composed, group) if group else composed)
    except Exception as error:
        raise explain_error(error) from error


def to_plain(cfg: DictConfig, *, resolve: bool = True) -> Values:
    """Return the values of OmegaConf's tree in dictionaries and lists."""
    values = OmegaConf.to_container(cfg, resolve=resolve, throw_on_missing=resolve)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def typed_overrides() -> list[str]:
    """Return the command line of the run that Hydra is running, as it was typed."""
    # Interpolations stay as they are: they belong into the configuration.
    typed = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
    return [str(word) for word in typed or ()]


def read_yaml(path: Path) -> Values:
    """Return what a YAML file holds, with interpolations as they are written.

    Raises:
        ConfigError: If it cannot be read, or holds no mapping.
    """
    try:
        loaded = OmegaConf.load(path)
    except Exception as error:
        raise explain_error(error) from error
    if not isinstance(loaded, DictConfig):
        raise ConfigError(f"'{path}' must hold keys and values.")
    return to_plain(loaded, resolve=False)


@contextlib.contextmanager
def initialized_hydra() -> Iterator[None]:
    """Prepare Hydra for the block, unless we are inside of an application of it."""
    if GlobalHydra.instance().is_initialized():
        yield
        return
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        yield


def friendly_override(argument: str) -> str:
    """Write an argument such that Hydra reads what was meant.

    Keys of open dictionaries get Hydra's ``++``, which always works. Text gets quotes where Hydra's
    grammar could not read it as text, and Python's tuples get brackets.

    >>> friendly_override("algorithm.gamma=0.9")
    '++algorithm.gamma=0.9'
    >>> friendly_override("algorithm=sac")
    'algorithm=sac'
    >>> friendly_override("+env_kwargs.reward_type=dense")
    '++env_kwargs.reward_type=dense'
    >>> friendly_override("record_when=critic_variance > p99")
    "record_when='critic_variance > p99'"
    """
    bare = re.sub(r"^\+{1,2}(?=[a-z])", "", argument)
    name, equals, value = bare.partition("=")
    if not equals:
        return argument
    if bare.startswith(_OPEN_GROUPS) or name == "env_kwargs":
        return f"++{name}={tuple_as_list(value)}"
    return f"{argument[: -len(bare)]}{name}={_readable(name, value)}"


def _readable(name: str, value: str) -> str:
    """Return the value of a key for text, or for a list of texts, as Hydra reads it."""
    if name in _TEXT_LISTS:
        return as_texts(value)
    if name in _TEXTS:
        return as_text(value, may_sweep=name not in _PROSE)
    return value


def explain_error(error: Exception) -> ConfigError:
    """Turn an error of Hydra or OmegaConf into one line for people."""
    if isinstance(error, ConfigError):
        return error
    missing = getattr(error, "missing_cfg_file", None)
    if missing is not None:
        group, _, given = str(missing).partition("/")
        if not given:
            return ConfigError(f"There is no configuration '{group}': leave --config-name out.")
        options = list(config_files(group))
        return ConfigError(
            f"There is no {group} '{given}'.{did_you_mean(given, options)} "
            f"There are: {listing(options, limit=40)}."
        )
    launcher_key = re.search(
        r"'hydra\.launcher\.(\w+)'|full_key: hydra\.launcher\.(\w+)", str(error)
    )
    if launcher_key is not None:
        key = launcher_key[1] or launcher_key[2]
        return ConfigError(
            f"There is no key 'hydra.launcher.{key}': choose the launcher that has it first, "
            "hydra/launcher=submitit_slurm, submitit_local or ray."
        )
    mark = getattr(error, "problem_mark", None)
    if mark is not None:
        return ConfigError(
            f"{mark.name}:{mark.line + 1}: {getattr(error, 'problem', None) or error}"
        )
    unknown = re.search(r"Could not override '([^']+)'", str(error))
    if unknown:
        return _unknown_override(unknown[1])
    first = next((line for line in str(error).splitlines() if line.strip()), repr(error)).strip()
    if first.startswith("Ambiguous value for argument"):
        return ConfigError(
            f"{first}: to train with each of these values, add --multirun; a list is "
            "written in brackets, as in tags=[a,b]."
        )
    if isinstance(error, OverrideParseException):
        return ConfigError(f"'{error.override}' cannot be read: {first}.")
    key = getattr(error, "full_key", None) if isinstance(error, OmegaConfBaseException) else None
    return ConfigError(f"{first}{f' (key {key})' if key else ''}")


def _unknown_override(key: str) -> ConfigError:
    if key in ALIASES:
        return ConfigError(f"Write +{key}=1 with a plus: it is not a key of main.yaml.")
    return unknown_key(key)
