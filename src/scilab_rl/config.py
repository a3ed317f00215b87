"""The keys of ``main.yaml``: their meaning, their checks, and the layers they come from.

Layers, later ones win: main, algorithm, tuned values for algorithm and environment, experiment file
(``+performance=``), command line.
"""

from __future__ import annotations

import importlib.util
import logging
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import hydra.utils
import yaml
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.workspace import SHIPPED_CONF, config_files

_log = logging.getLogger(__name__)

NUMBER, WHOLE, TEXT, SWITCH, MAPPING, LIST = (
    "number",
    "whole number",
    "text",
    "switch",
    "mapping",
    "list",
)


@dataclass(frozen=True)
class Key:
    """One key of ``main.yaml``.

    Attributes:
        name: The key.
        kind: What its value is.
        meaning: One sentence for ``--help`` and the reference.
        low: Smallest allowed number.
        high: Largest allowed number.
        choices: Allowed words.
        optional: Whether null is allowed.
    """

    name: str
    kind: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[Any, ...] = ()
    optional: bool = False


KEYS = (
    Key("env", TEXT, "id of the environment; without version: the newest"),
    Key(
        "env_kwargs",
        MAPPING,
        "keyword arguments of the environment (+env_kwargs.reward_type=dense)",
    ),
    Key("wrappers", LIST, "wrappers around the environment, each with a _target_"),
    Key("n_envs", WHOLE, "training environments side by side", low=1, high=4096),
    Key(
        "vector",
        TEXT,
        "where they run: in the main process, in one process per core, in a process each",
        choices=("inprocess", "workers", "subprocess"),
    ),
    Key("fast_fetch", SWITCH, "make Fetch's steps faster; its observations stay the same"),
    Key(
        "on_nan",
        TEXT,
        "what an observation or reward that is no number does",
        choices=("stop", "end_episode", "ignore"),
    ),
    Key("warn_after_seconds", NUMBER, "time without a step until a warning; 0: never", low=0),
    Key(
        "tuned", SWITCH, "use the tuned values for this algorithm and environment, if there are any"
    ),
    Key("seed", WHOLE, "seed of everything; 0 draws one and records it", low=0, high=2**32 - 1),
    Key("eval_after_n_steps", WHOLE, "environment steps per epoch", low=1),
    Key("n_epochs", WHOLE, "most epochs", low=1),
    Key("n_test_rollouts", WHOLE, "evaluation episodes after each epoch", low=1),
    Key("early_stop_data_column", TEXT, "metric that may end the run early"),
    Key("early_stop_threshold", NUMBER, "value at which it does"),
    Key("early_stop_last_n", WHOLE, "over how many epochs it is averaged", low=1),
    Key("hyperopt_criterion", TEXT, "metric whose last value is the score of the run"),
    Key(
        "render",
        TEXT,
        "display: live viewer; record: video and replay page; human: the task's own window",
        choices=("none", "display", "record", "human"),
    ),
    Key("render_freq", WHOLE, "epochs between rendered ones", low=1),
    Key("render_metrics_train", LIST, "metrics drawn beside training episodes"),
    Key("render_metrics_test", LIST, "metrics drawn beside evaluation episodes"),
    Key("render_frames_per_clip", WHOLE, "scenes per rendered clip; 0: one episode", low=0),
    Key(
        "record_when",
        TEXT,
        "with render=record: keep only moments, such as 'critic_variance > p99' or 'object fell'",
        optional=True,
    ),
    Key("viewer_host", TEXT, "address of the live view; others than 127.0.0.1 let others look"),
    Key("base_logdir", TEXT, "folder of all runs"),
    Key("restore_policy", TEXT, "folder of a saved policy to start from", optional=True),
    Key(
        "save_model_freq",
        WHOLE,
        "environment steps between checkpoints; 0: only when stopped",
        low=0,
    ),
    Key("info", TEXT, "a note to yourself, kept with the run"),
    Key("mlflow", SWITCH, "track with MLflow; auto: when it is installed", choices=("auto",)),
    Key("wandb", SWITCH, "track with Weights & Biases (offline without a key)"),
    Key("tensorboard", SWITCH, "write TensorBoard event files"),
    Key("project_name", TEXT, "project (W&B) or experiment (MLflow)", optional=True),
    Key("entity", TEXT, "team on Weights & Biases", optional=True),
    Key("group", TEXT, "group of runs, for trackers", optional=True),
    Key("tags", LIST, "tags of the run, for trackers", optional=True),
    Key("device", TEXT, "auto, cpu, cuda, cuda:0, mps"),
    Key(
        "n_threads",
        WHOLE,
        "CPU threads of PyTorch; 1 is fastest for small networks",
        low=1,
        high=4096,
    ),
)
GROUPS = ("algorithm", "tracking")
# What the runs of a performance test have to reach; a single run does not look at it.
CONDITIONS = "performance_testing_conditions"
# Parts of the configuration that are dictionaries: their keys can be added without Hydra's plus.
_OPEN_GROUPS = ("algorithm.", "env_kwargs.")

# Packages that the configuration of an earlier run may name.
_TRUSTED = (
    "scilab_rl.", "custom_algorithms.", "custom_envs.", "custom_probes.",
    "stable_baselines3.", "sb3_contrib.", "gymnasium.", "gymnasium_robotics.", "torch.nn.",
)  # fmt: skip
_FLATTEN = {"_target_": "gymnasium.wrappers.FlattenObservation"}
_CLIP = {"_target_": "scilab_rl.envs.clipping.ClipAction"}
_TIME = {"_target_": "gymnasium.wrappers.TimeAwareObservation"}
_NORMALIZE = "stable_baselines3.common.vec_env.VecNormalize"
ALIASES = (
    "clip_action",
    "time_aware_observation",
    "flatten_obs",
    "normalize_obs",
    "normalize_reward",
)

_KNOWN_METRICS = (
    "eval/success_rate",
    "eval/success_once_rate",
    "eval/mean_reward",
    "eval/mean_ep_length",
    "eval/rollout_rewards_step",
    "rollout/success_rate",
    "rollout/ep_rew_mean",
    "rollout/intrinsic_ep_rew_mean",
    "rollout/ep_len_mean",
)


def compose(overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration for these overrides, with tuned values where they apply.

    Must run inside a Hydra application, or inside ``hydra.initialize...``.

    Raises:
        ConfigError: If it cannot be composed.
    """
    try:
        cfg = hydra.compose("main", overrides=list(overrides))
        tuned = tuned_option(cfg)
        if tuned is None:
            return cfg
        check_keys(cfg)  # errors before notices
        _log.info(
            "Tuned values for %s are used: %s (off with tuned=false).",
            tuned.replace("/", " with "),
            _near(config_files("tuned_values")[tuned]),
        )
        return hydra.compose("main", overrides=[f"+tuned_values={tuned}", *overrides])
    except Exception as error:
        raise explain_error(error) from error


def load_recorded(path: Path, overrides: Sequence[str] = ()) -> DictConfig:
    """Load the configuration of an earlier run, which is data: it may not name foreign code.

    Args:
        path: A ``config.yaml`` that a run has written.
        overrides: ``key=value`` changes by the user.

    Raises:
        ConfigError: If it cannot be read, or names anything but algorithms, environments and
            wrappers of the framework, its libraries and the desk.
    """
    try:
        cfg = OmegaConf.load(path)
        assert isinstance(cfg, DictConfig)
        refuse_foreign_code(OmegaConf.to_container(cfg, resolve=False), path)
        changes = OmegaConf.from_dotlist([override.lstrip("+") for override in overrides])
        # Keys that are newer than the run get their default.
        return OmegaConf.merge(_defaults(), cfg, changes)  # type: ignore[return-value]
    except (OSError, AssertionError, ValueError, OmegaConfBaseException, yaml.YAMLError) as error:
        raise explain_error(error) from error


def _defaults() -> DictConfig:
    cfg = OmegaConf.load(SHIPPED_CONF / "main.yaml")
    assert isinstance(cfg, DictConfig)
    return OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key not in ("defaults", "hydra")])


def refuse_foreign_code(value: Any, path: Path) -> None:
    """Refuse interpolations and targets outside the framework, its libraries and the desk."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            if key in ("_target_", "path", "replay_buffer_class") and isinstance(entry, str):
                _refuse_foreign_class(entry, path)
            refuse_foreign_code(entry, path)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            refuse_foreign_code(entry, path)
    elif isinstance(value, str) and "${" in value:
        raise ConfigError(f"'{path}' holds the interpolation {value!r}; recorded runs hold values.")


def _refuse_foreign_class(target: str, path: Path) -> None:
    if target in ("auto", "her", "hydra.utils.get_class"):
        return
    if target.startswith(_TRUSTED):
        try:
            found = hydra.utils.get_class(target)
        except Exception as error:
            raise ConfigError(f"'{path}' names '{target}', which cannot be found.") from error
        if found.__module__.startswith(_TRUSTED):
            return
    raise ConfigError(
        f"'{path}' names '{target}', which is no part of Scilab-RL, its libraries or your desk. "
        "A recorded run is data and must not bring code with it."
    )


def friendly_override(argument: str) -> str:
    """Add Hydra's ``++`` where a key of an open dictionary is set: same meaning, always works.

    >>> friendly_override("algorithm.gamma=0.9")
    '++algorithm.gamma=0.9'
    >>> friendly_override("algorithm=sac")
    'algorithm=sac'
    >>> friendly_override("+env_kwargs.reward_type=dense")
    '++env_kwargs.reward_type=dense'
    """
    bare = re.sub(r"^\+{1,2}(?=[a-z])", "", argument)
    return f"++{bare}" if bare.startswith(_OPEN_GROUPS) and "=" in bare else argument


def _near(path: Path) -> Path:
    """Return a path as seen from here when it is below here."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def tuned_option(cfg: DictConfig) -> str | None:
    """Return the option of the group ``tuned_values`` that fits, such as ``FetchReach/sac``."""
    if not cfg.get("tuned", False) or not isinstance(cfg.get("env"), str):
        return None
    family = re.sub(r"-v\d+$", "", cfg.env)
    option = f"{family}/{cfg.algorithm.get('name')}"
    return option if option in config_files("tuned_values") else None


def prepare(cfg: DictConfig) -> DictConfig:
    """Return a checked copy with the aliases for wrappers replaced by what they stand for.

    Raises:
        ConfigError: If a key is unknown or a value cannot be.
    """
    cfg = cfg.copy()
    check_keys(cfg)
    with open_dict(cfg):
        cfg.wrappers = [*_aliased_wrappers(cfg), *cfg.wrappers]
        for name in (*ALIASES, CONDITIONS):
            cfg.pop(name, None)
    return cfg


def check_keys(cfg: DictConfig) -> None:
    """Refuse unknown keys and values of the wrong type or out of range."""
    known = {key.name: key for key in KEYS}
    for name in map(str, cfg):
        if name not in known and name not in (*GROUPS, *ALIASES, CONDITIONS, "hydra"):
            raise ConfigError(
                f"There is no key '{name}'.{did_you_mean(name, [*known, *GROUPS, *ALIASES])} "
                "`scilab-rl --help` lists all keys."
            )
    for key in KEYS:
        _check_value(key, cfg.get(key.name))
    for alias in ALIASES:
        if alias in cfg and cfg[alias] not in (0, 1):
            raise ConfigError(f"{alias} must be 0 or 1, but it is {cfg[alias]!r}.")
    for name in ("early_stop_data_column", "hyperopt_criterion"):
        _check_metric(name, cfg[name])
    if not isinstance(cfg.get("algorithm"), DictConfig) or not cfg.algorithm.get("_target_"):
        raise ConfigError("The algorithm's YAML must have a _target_, the class that learns.")


def switched_on(value: Any, package: str | None = None) -> bool:
    """Tell whether a switch is on; ``auto`` means: when the package is installed."""
    if value == "auto":
        return package is not None and importlib.util.find_spec(package) is not None
    return bool(value)


def flat(cfg: DictConfig) -> dict[str, Any]:
    """Return the configuration as one level: ``algorithm.gamma`` to its value."""
    return dict(_flatten(OmegaConf.to_container(cfg, resolve=True), ""))


def explain_error(error: Exception) -> ConfigError:
    """Turn an error of Hydra or OmegaConf into one line for people."""
    if isinstance(error, ConfigError):
        return error
    missing = getattr(error, "missing_cfg_file", None)
    if missing is not None:
        group, _, given = str(missing).partition("/")
        options = list(config_files(group))
        return ConfigError(
            f"There is no {group} '{given}'.{did_you_mean(given, options)} "
            f"There are: {listing(options, limit=40)}."
        )
    mark = getattr(error, "problem_mark", None)
    if mark is not None:
        return ConfigError(
            f"{mark.name}:{mark.line + 1}: {getattr(error, 'problem', None) or error}"
        )
    unknown = re.search(r"Could not override '([^']+)'", str(error))
    if unknown:
        return _unknown_override(unknown[1])
    first_line = next((line for line in str(error).splitlines() if line.strip()), repr(error))
    if isinstance(error, OverrideParseException):
        return ConfigError(f"'{error.override}' cannot be read: {first_line.strip()}.")
    key = getattr(error, "full_key", None) if isinstance(error, OmegaConfBaseException) else None
    return ConfigError(f"{first_line.strip()}{f' (key {key})' if key else ''}")


def _unknown_override(key: str) -> ConfigError:
    names = [*(k.name for k in KEYS), *GROUPS, *ALIASES]
    if key in ALIASES:
        return ConfigError(f"Write +{key}=1 with a plus: it is no key of main.yaml.")
    return ConfigError(
        f"There is no key '{key}'.{did_you_mean(key.partition('.')[0], names)} "
        "`scilab-rl --help` lists all keys."
    )


def _check_value(key: Key, value: Any) -> None:
    if value is None:
        if not key.optional:
            raise ConfigError(f"{key.name} must be a {key.kind}, but it is empty.")
        return
    if value in key.choices:
        return
    if key.choices and key.kind != SWITCH:
        raise ConfigError(
            f"{key.name} must be one of {', '.join(map(str, key.choices))}, but it is {value!r}."
            f"{did_you_mean(str(value), map(str, key.choices))}"
        )
    if not _KINDS[key.kind](value):
        raise ConfigError(f"{key.name} must be a {key.kind}, but it is {value!r}.")
    if key.kind in (NUMBER, WHOLE) and value < key.low:
        raise ConfigError(f"{key.name} must be at least {key.low:g}, but it is {value}.")
    if key.kind in (NUMBER, WHOLE) and value > key.high:
        raise ConfigError(f"{key.name} must be at most {key.high}, but it is {value}.")
    if value == "" and key.name != "info":
        raise ConfigError(f"{key.name} must be a {key.kind}, but it is empty.")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


_KINDS: Mapping[str, Callable[[Any], bool]] = {
    NUMBER: _is_number,
    WHOLE: lambda value: _is_number(value) and float(value).is_integer(),
    TEXT: lambda value: isinstance(value, str),
    SWITCH: lambda value: isinstance(value, (bool, int)) and value in (0, 1),
    MAPPING: lambda value: isinstance(value, (dict, DictConfig)),
    LIST: lambda value: isinstance(value, Sequence) and not isinstance(value, str),
}


def _check_metric(name: str, metric: str) -> None:
    section = metric.partition("/")[0]
    if metric in _KNOWN_METRICS or section in ("train", "time"):
        return
    raise ConfigError(
        f"{name}: there is no metric '{metric}'.{did_you_mean(metric, _KNOWN_METRICS)} "
        f"There are {', '.join(_KNOWN_METRICS)} and what the algorithm records as train/..."
    )


def _aliased_wrappers(cfg: DictConfig) -> list[dict[str, Any]]:
    wrappers: list[dict[str, Any]] = []
    if cfg.get("clip_action"):
        wrappers.append(_CLIP)
    if cfg.get("time_aware_observation"):
        wrappers.append(_TIME)
    if cfg.get("flatten_obs"):
        wrappers.append(_FLATTEN)
    observations, rewards = bool(cfg.get("normalize_obs")), bool(cfg.get("normalize_reward"))
    if observations or rewards:
        wrappers.append({"_target_": _NORMALIZE, "norm_obs": observations, "norm_reward": rewards})
    return wrappers


def _flatten(value: Any, prefix: str) -> Iterable[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for key, entry in value.items():
            yield from _flatten(entry, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, value
