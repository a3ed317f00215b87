"""The configuration of a run: its keys with their types, ranges and meaning, and their checks."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeGuard, TypeVar

from scilab_rl.errors import ConfigError, did_you_mean

# What YAML holds below a key, in plain dictionaries and lists.
Values: TypeAlias = Mapping[str, Any]
_T = TypeVar("_T")

NUMBER, INTEGER, STRING, BOOLEAN, MAPPING, LIST = (
    "number", "whole number", "text", "switch", "mapping", "list",
)  # fmt: skip
# Groups of files; what they hold is checked by the classes that they name.
GROUPS = ("algorithm", "tracking")
# What the runs of a performance test have to reach; a single run does not look at it.
CONDITIONS = "performance_testing_conditions"
_FLATTEN = {"_target_": "gymnasium.wrappers.FlattenObservation"}
_CLIP = {"_target_": "scilab_rl.envs.clipping.ClipAction"}
_TIME = {"_target_": "gymnasium.wrappers.TimeAwareObservation"}
_NORMALIZE = "stable_baselines3.common.vec_env.VecNormalize"
ALIASES = (
    "clip_action", "time_aware_observation", "flatten_obs", "normalize_obs", "normalize_reward",
)  # fmt: skip


def _key(default: object, meaning: str, **facts: object) -> Any:
    """Return the field of a key; ``facts`` are attributes of `Key`."""
    facts = {"meaning": meaning, **facts}
    if isinstance(default, (dict, list)):
        return dataclasses.field(default_factory=default.copy, metadata=facts)
    return dataclasses.field(default=default, metadata=facts)


_neutral = functools.partial(_key, affects_learning=False)  # a key that does not affect learning


@dataclass(frozen=True)
class AlgorithmConfig:
    """The part of a configuration that says what learns.

    Attributes:
        name: The algorithm's name.
        target: Its class, as ``package.module.Class``.
        arguments: Keyword arguments of the class.
    """

    name: str = ""
    target: str = ""
    arguments: Values = dataclasses.field(default_factory=dict)


@dataclass(frozen=True)
class RunConfig:
    """The configuration of one run: made once, checked, and handed to all parts of the run.

    Names, order, defaults and headings are those of ``main.yaml``. A key that does not affect
    learning changes neither what a run learns nor how that is measured: runs that differ in such
    keys or in their seeds only are repeats of one another.
    """

    env: str = _key(
        "FetchReach", "id of the environment; without version: the newest",
        heading="What learns where",
    )  # fmt: skip
    env_kwargs: Values = _key(  # noqa: RUF009 - it returns a field
        {}, "keyword arguments of the environment (+env_kwargs.reward_type=dense)"
    )
    wrappers: Sequence[Values | Callable[..., object]] = _key(
        [], "wrappers around the environment, each with a _target_"
    )  # fmt: skip
    n_envs: int = _key(1, "training environments side by side", low=1, high=4096)
    vector: Literal["inprocess", "threads", "workers", "subprocess"] = _neutral(
        "inprocess",
        "where they run: in the main process, there in one thread per core (MuJoCo only), in one "
        "process per core, in a process each",
    )
    fast_fetch: bool = _neutral(True, "make Fetch's steps faster; its observations stay the same")
    on_nan: Literal["stop", "end_episode", "ignore"] = _key(
        "stop", "the response to an observation or reward that is not a number"
    )
    warn_after_seconds: float = _neutral(
        300, "time without a step until a warning; 0: never", low=0
    )
    tuned: bool = _neutral(
        True, "use the tuned values for this algorithm and environment, if there are any"
    )
    seed: int = _key(0, "seed of everything; 0 draws one and records it", low=0, high=2**32 - 1)

    eval_after_n_steps: int = _key(
        2000, "environment steps per epoch", low=1, heading="How long, and how it is measured"
    )
    n_epochs: int = _key(60, "most epochs", low=1)
    n_test_rollouts: int = _key(10, "evaluation episodes after each epoch", low=1)
    require_updates: bool = _neutral(
        True, "refuse a run that ends before the algorithm's first update; false only warns"
    )
    early_stop_data_column: str = _key("eval/success_rate", "metric that may end the run early")
    early_stop_threshold: float = _key(0.9, "value at which it does")
    early_stop_last_n: int = _key(3, "over how many epochs it is averaged", low=1)
    hyperopt_criterion: str = _key(
        "eval/success_rate", "metric whose last value is the score of the run"
    )

    render: Literal["none", "display", "record", "human"] = _neutral(
        "none",
        "display: live viewer; record: video and replay page; human: the task's own window",
        heading="What is shown",
    )
    render_view: Literal["task", "close"] = _neutral(
        "task",
        "close: a plain background and a nearer camera, for MuJoCo tasks; only pictures change",
    )
    render_freq: int = _neutral(5, "epochs between rendered ones", low=1)
    render_metrics_train: Sequence[str] = _neutral(
        ["train/rollout_rewards_step"], "metrics shown with training episodes"
    )
    render_metrics_test: Sequence[str] = _neutral(
        ["eval/rollout_rewards_step"], "metrics shown with evaluation episodes"
    )
    render_frames_per_clip: int = _neutral(0, "scenes per rendered clip; 0: one episode", low=0)
    record_when: str | None = _neutral(
        None,
        "with render=record: keep only such highlights as 'critic_variance > p99' or 'object fell'",
    )
    viewer_host: str = _neutral(
        "127.0.0.1", "address of the live view; others than 127.0.0.1 let others look"
    )

    base_logdir: str = _neutral("data", "folder of all runs", heading="What is kept")
    restore_policy: str | None = _key(None, "saved policy, or run, to start from")
    save_model_freq: int = _neutral(
        0, "environment steps between checkpoints, one more at the end; 0: when stopped", low=0
    )
    keep_policies: int = _neutral(
        0, "epochs between policies that are kept besides the best and the last; 0: none", low=0
    )
    info: str = _neutral("", "a note to yourself, kept with the run")

    mlflow: bool | Literal["auto"] = _neutral(
        "auto", "track with MLflow; auto: when it is installed", heading="Trackers"
    )
    wandb: bool = _neutral(0, "track with Weights & Biases (offline without a key)")
    tensorboard: bool = _neutral(0, "write TensorBoard event files")
    project_name: str | None = _neutral(None, "project (W&B) or experiment (MLflow)")
    entity: str | None = _neutral(None, "team on Weights & Biases")
    group: str | None = _neutral(None, "group of runs, for trackers")
    tags: Sequence[object] | None = _neutral(None, "tags of the run, for trackers")

    device: str = _neutral("auto", "auto, cpu, cuda, cuda:0, mps", heading="The machine")
    n_threads: int = _neutral(
        1,
        "CPU threads of PyTorch, JAX and NumPy; 1 is fastest for small networks",
        low=1,
        high=4096,
    )

    algorithm: AlgorithmConfig = dataclasses.field(default_factory=AlgorithmConfig)
    tracking: Mapping[str, Values] = dataclasses.field(default_factory=dict)
    performance_testing_conditions: object = None

    @classmethod
    def from_values(cls, values: Values) -> RunConfig:
        """Check values as YAML has them, and replace the aliases for wrappers by what they mean.

        Keys that are left out get their default.

        Raises:
            ConfigError: If a key is unknown or a value is invalid.
        """
        _check_names(values)
        given = {key.name: key.read(values[key.name]) for key in KEYS if key.name in values}
        # Normalization is outermost: algorithms store what is directly below it.
        wrappers = [*_inner_wrappers(values), *given.pop("wrappers", ()), *_normalization(values)]
        algorithm = values.get("algorithm")
        if not isinstance(algorithm, Mapping) or not algorithm.get("_target_"):
            raise ConfigError("The algorithm's YAML must have a _target_, the class that learns.")
        arguments = {k: v for k, v in algorithm.items() if k not in ("name", "_target_")}
        target = str(algorithm["_target_"])
        name = str(algorithm.get("name", target.rpartition(".")[2]))
        return cls(
            **given,
            wrappers=wrappers,
            algorithm=AlgorithmConfig(name, target, arguments),
            tracking=values.get("tracking") or {},
            performance_testing_conditions=values.get(CONDITIONS),
        )

    def values(self) -> dict[str, object]:
        """Return the configuration as YAML has it, without the conditions of a performance test."""
        named = {"name": self.algorithm.name, "_target_": self.algorithm.target}
        return {
            **{key.name: getattr(self, key.name) for key in KEYS},
            "algorithm": {**named, **self.algorithm.arguments},
            "tracking": self.tracking,
        }

    def flat(self) -> dict[str, object]:
        """Return the values of all keys on one level, such as ``algorithm.gamma``."""
        return dict(flatten(self.values()))

    @property
    def total_steps(self) -> int:
        """Environment steps of all epochs together."""
        return self.eval_after_n_steps * self.n_epochs


@dataclass(frozen=True)
class Key:
    """One key of ``main.yaml``.

    Attributes:
        name: The key.
        kind: What its value is.
        default: Its value where nothing else is said.
        meaning: One sentence for ``--help`` and the reference.
        heading: What it is about, together with the keys around it.
        low: Smallest allowed number.
        high: Largest allowed number.
        choices: Allowed words.
        optional: Whether null is allowed.
        affects_learning: Whether it changes what a run learns or how that is measured.
    """

    name: str
    kind: str
    default: object
    meaning: str
    heading: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    optional: bool = False
    affects_learning: bool = True

    def read(self, value: Any) -> Any:
        """Return a value in the type of its field.

        Raises:
            ConfigError: If it cannot be.
        """
        if (value is None and self.optional) or value in self.choices:
            return value
        if value is None:
            raise ConfigError(f"{self.name} must be a {self.kind}, but it is empty.")
        if self.choices and self.kind != BOOLEAN:
            raise ConfigError(
                f"{self.name} must be one of {', '.join(self.choices)}, but it is {value!r}."
                f"{did_you_mean(str(value), self.choices)}"
            )
        if not _KINDS[self.kind](value):
            raise ConfigError(f"{self.name} must be a {self.kind}, but it is {value!r}.")
        if self.kind in (NUMBER, INTEGER) and value < self.low:
            raise ConfigError(f"{self.name} must be at least {self.low:g}, but it is {value}.")
        if self.kind in (NUMBER, INTEGER) and value > self.high:
            raise ConfigError(f"{self.name} must be at most {self.high}, but it is {value}.")
        if value == "" and self.default != "":
            raise ConfigError(f"{self.name} must be a {self.kind}, but it is empty.")
        return {INTEGER: int, BOOLEAN: bool}.get(self.kind, lambda v: v)(value)

    @property
    def allowed(self) -> list[str]:
        """What its value may be, in words."""
        kinds = ("0", "1") if self.kind == BOOLEAN else () if self.choices else (self.kind,)
        return [*kinds, *self.choices]


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


_KINDS: Mapping[str, Callable[[object], bool]] = {
    NUMBER: _is_number,
    INTEGER: lambda value: _is_number(value) and float(value).is_integer(),
    STRING: lambda value: isinstance(value, str),
    BOOLEAN: lambda value: isinstance(value, (bool, int)) and value in (0, 1),
    MAPPING: lambda value: isinstance(value, Mapping),
    LIST: lambda value: isinstance(value, Sequence) and not isinstance(value, str),
}
_KIND_OF = {
    float: NUMBER, int: INTEGER, str: STRING, bool: BOOLEAN, Literal: STRING,
    typing.get_origin(Values): MAPPING, typing.get_origin(Sequence[str]): LIST,
}  # fmt: skip


def _read_keys() -> Iterator[Key]:
    """Yield the keys that the fields of `RunConfig` declare."""
    hints, heading = typing.get_type_hints(RunConfig), ""
    for field in dataclasses.fields(RunConfig):
        if not field.metadata:
            continue
        heading = field.metadata.get("heading", heading)
        hint = hints[field.name]
        is_union = typing.get_origin(hint) in (typing.Union, types.UnionType)
        members = typing.get_args(hint) if is_union else (hint,)
        words = [typing.get_args(m) for m in members if typing.get_origin(m) is Literal]
        factory = field.default_factory
        yield Key(
            name=field.name,
            kind=_KIND_OF[typing.get_origin(members[0]) or members[0]],
            default=field.default if factory is dataclasses.MISSING else factory(),
            choices=sum(words, ()),
            optional=types.NoneType in members,
            **{**field.metadata, "heading": heading},
        )


KEYS = tuple(_read_keys())
_NOT_LEARNING = {key.name for key in KEYS if not key.affects_learning} | {"seed", "tracking"}


def learning_part(flat_config: Mapping[str, _T]) -> dict[str, _T]:
    """Return the dotted keys that affect learning: runs are repeats when these are equal.

    The seed is not among them. What was stored by an earlier version is to be filtered, too, before
    it is compared.

    >>> learning_part({"algorithm.gamma": 0.9, "viewer_host": "127.0.0.1", "seed": 3})
    {'algorithm.gamma': 0.9}
    """
    return {k: v for k, v in flat_config.items() if k.partition(".")[0] not in _NOT_LEARNING}


def learning_config(values: Values) -> dict[str, str]:
    """Return the part of a run's configuration that affects learning, used to match runs.

    Args:
        values: Of all keys, in plain dictionaries and lists.

    Returns:
        Dotted keys with their values as JSON.

    >>> learning_config({"seed": 3, "algorithm": {"gamma": 0.9}, "env_kwargs": {}})
    {'algorithm.gamma': '0.9'}
    """
    learning = learning_part(dict(flatten(values)))
    return {key: json.dumps(value) for key, value in learning.items() if value != {}}


def unknown_key(name: str) -> ConfigError:
    """Return the error about a key that there is not."""
    known = [*(key.name for key in KEYS), *GROUPS, *ALIASES]
    return ConfigError(
        f"There is no key '{name}'.{did_you_mean(name.partition('.')[0], known)} "
        "`scilab-rl --help all` lists all keys."
    )


def _check_names(values: Values) -> None:
    known = {*(key.name for key in KEYS), *GROUPS, *ALIASES, CONDITIONS}
    for name in map(str, values):
        if name not in known:
            raise unknown_key(name)
    for alias in ALIASES:
        if values.get(alias, 0) not in (0, 1):
            raise ConfigError(f"{alias} must be 0 or 1, but it is {values[alias]!r}.")


def _inner_wrappers(values: Values) -> list[Values]:
    aliased = {"clip_action": _CLIP, "time_aware_observation": _TIME, "flatten_obs": _FLATTEN}
    return [wrapper for alias, wrapper in aliased.items() if values.get(alias)]


def _normalization(values: Values) -> list[Values]:
    observations, rewards = bool(values.get("normalize_obs")), bool(values.get("normalize_reward"))
    if not observations and not rewards:
        return []
    return [{"_target_": _NORMALIZE, "norm_obs": observations, "norm_reward": rewards}]


def is_enabled(value: object, package: str | None = None) -> bool:
    """Return whether a switch is on; ``auto`` means: when the package is installed."""
    if value == "auto":
        return package is not None and importlib.util.find_spec(package) is not None
    return bool(value)


def flatten(value: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yield the dotted keys of nested dictionaries with their values; empty ones are values too.

    >>> dict(flatten({"a": {"b": {"c": 1}, "d": {}}, "e": [1]}))
    {'a.b.c': 1, 'a.d': {}, 'e': [1]}
    """
    if isinstance(value, Mapping) and value:
        for key, entry in value.items():
            yield from flatten(entry, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, value
