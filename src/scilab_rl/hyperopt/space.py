"""The search space: from YAML or the command line to Optuna's distributions and back to overrides.

A *setting* is one point of the space: parameter name to value.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from scilab_rl.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    import optuna
    from hydra.core.override_parser.types import Override

Setting = dict[str, Any]
KINDS = ("float", "int", "categorical")
_ENTRY_KEYS = ("type", "low", "high", "step", "log", "choices", "when")
_ABSENT = object()
_SCALARS = (bool, int, float, str, type(None))


@dataclass(frozen=True)
class Parameter:
    """One dimension of the search space.

    Attributes:
        key: What stands before the ``=`` of the override, for example ``++algorithm.gamma``.
        kind: ``float``, ``int`` or ``categorical``.
        low: Smallest value, inclusive.
        high: Largest value, inclusive.
        step: Distance of neighbouring values, or None for any value.
        log: Whether values are drawn on a logarithmic scale.
        choices: The values of a categorical parameter.
        when: Other parameters and the values at which this one exists; always, when empty.
    """

    key: str
    kind: str
    low: float | None = None
    high: float | None = None
    step: float | None = None
    log: bool = False
    choices: tuple[Any, ...] = ()
    when: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The key without plus signs."""
        return self.key.lstrip("+")

    @property
    def labels(self) -> tuple[Any, ...]:
        """The choices as Optuna stores them: numbers, words, and lists as they are typed."""
        return tuple(c if isinstance(c, _SCALARS) else override_text(c) for c in self.choices)

    def override(self, value: Any) -> str:
        """Return the override that sets this parameter to one of its values."""
        if self.kind == "categorical":
            value = self.choices[self.labels.index(value)]
        return f"{self.key}={override_text(value)}"

    def exists_in(self, setting: Setting) -> bool:
        """Tell whether the parameter exists beside these values of the parameters before it."""
        return all(name in setting and setting[name] == v for name, v in self.when.items())

    def suggest(self, trial: optuna.Trial) -> Any:
        """Ask the sampler for a value."""
        if self.kind == "categorical":
            return trial.suggest_categorical(self.name, self.labels)
        assert self.low is not None and self.high is not None
        if self.kind == "int":
            return trial.suggest_int(
                self.name, int(self.low), int(self.high), step=int(self.step or 1), log=self.log
            )
        return trial.suggest_float(self.name, self.low, self.high, step=self.step, log=self.log)

    def values(self) -> list[Any] | None:
        """Return all values, or None when there is a continuum of them."""
        if self.kind == "categorical":
            return list(self.labels)
        assert self.low is not None and self.high is not None
        if self.kind == "int":
            return list(range(int(self.low), int(self.high) + 1, int(self.step or 1)))
        if self.step is None:
            return None
        # The small surplus forgives a step such as 0.1 that has no exact binary form.
        count = math.floor((self.high - self.low) / self.step + 1e-9) + 1
        return [self.low + i * self.step for i in range(count)]

    def own(self, value: Any) -> list[Any]:
        """Return the value as the parameter has it, in a list that is empty when it has not."""
        if self.kind == "categorical":
            typed = override_text(value)
            pairs = zip(self.choices, self.labels, strict=True)
            return [label for choice, label in pairs if override_text(choice) == typed][:1]
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return []
        values = self.values()
        if values is not None:
            return [v for v in values if math.isclose(v, value, rel_tol=1e-9)]
        assert self.low is not None and self.high is not None
        return [value] if self.low <= value <= self.high else []

    def describe(self) -> dict[str, Any]:
        """Return what can be written as JSON and compared."""
        empty = ("None", "False", "()", "{}")  # but not 0, which is a bound
        described = {k: v for k, v in asdict(self).items() if repr(v) not in empty}
        return described | ({"choices": list(self.labels)} if self.choices else {})


class SearchSpace:
    """All parameters, in the order in which they are drawn.

    Args:
        parameters: The parameters; one that depends on others comes after them.
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self.parameters = list(parameters)
        names = [parameter.name for parameter in self.parameters]
        for i, parameter in enumerate(self.parameters):
            if parameter.name in names[:i]:
                raise ConfigError(f"search_space: '{parameter.name}' is given twice.")
            for other in parameter.when:
                if other not in names[:i]:
                    raise ConfigError(
                        f"search_space: '{parameter.name}' exists when '{other}' has a value, so "
                        f"'{other}' must come before it.{did_you_mean(other, names)}"
                    )

    def suggest(self, trial: optuna.Trial) -> Setting:
        """Let the sampler of the trial's study choose a setting."""
        setting: Setting = {}
        for parameter in self.parameters:
            if parameter.exists_in(setting):
                setting[parameter.name] = parameter.suggest(trial)
        return setting

    def setting_in(self, values: Mapping[str, Any]) -> Setting | None:
        """Return the setting that a configuration has, or None where the space does not hold it.

        Args:
            values: Name to value, as in ``config.flat``.
        """
        setting: Setting = {}
        for parameter in self.parameters:
            if parameter.exists_in(setting):
                if not (own := parameter.own(values.get(parameter.name, _ABSENT))):
                    return None
                setting[parameter.name] = own[0]
        return setting

    def overrides(self, setting: Setting) -> list[str]:
        """Return the overrides that make a run use this setting."""
        return [p.override(setting[p.name]) for p in self.parameters if p.name in setting]

    def all_settings(self) -> Iterator[Setting]:
        """Yield each setting of a finite space once.

        Raises:
            ConfigError: If a parameter is continuous.
        """
        seen = set()
        for combination in itertools.product(*(self._values(p) for p in self.parameters)):
            setting: Setting = {}
            for parameter, value in zip(self.parameters, combination, strict=True):
                if parameter.exists_in(setting):
                    setting[parameter.name] = value
            if (identity := tuple(map(repr, setting.items()))) not in seen:
                seen.add(identity)
                yield setting

    def size(self) -> float:
        """Return how many settings there are at most; infinite for a continuous parameter."""
        counts = [p.values() for p in self.parameters]
        return math.prod(math.inf if values is None else len(values) for values in counts)

    def describe(self) -> dict[str, Any]:
        """Return what can be written as JSON and compared."""
        return {parameter.name: parameter.describe() for parameter in self.parameters}

    def _values(self, parameter: Parameter) -> list[Any]:
        values = parameter.values()
        if values is None:
            raise ConfigError(
                f"search_space: '{parameter.name}' has infinitely many values; give it a step or "
                "choices, or take another sampler than grid."
            )
        return values


def parse_space(entries: Mapping[str, Any]) -> list[Parameter]:
    """Read the ``search_space`` of a sweeper file.

    Args:
        entries: Override key, such as ``++algorithm.gamma``, to its description: ``type`` (float,
            int or categorical), ``low``, ``high``, ``step``, ``log``, ``choices``, ``when``.

    Raises:
        ConfigError: If an entry cannot be understood.
    """
    return [_parse_entry(str(key), entry) for key, entry in entries.items()]


def parameter_of(override: Override) -> Parameter:
    """Turn a sweep on the command line into a parameter.

    Args:
        override: For example ``algorithm.gamma=interval(0.9,0.99)``, ``a=choice(1,2)``,
            ``a=range(1,9,2)``, ``a=tag(log,interval(1e-5,1e-2))`` or ``a=int(interval(1,8))``.
    """
    from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, RangeSweep

    key, sweep = override.get_key_element(), override.value()
    if isinstance(sweep, ChoiceSweep):
        return Parameter(key, "categorical", choices=tuple(override.sweep_iterator()))
    assert isinstance(sweep, (IntervalSweep, RangeSweep))
    log = "log" in sweep.tags
    if isinstance(sweep, IntervalSweep):
        kind = "int" if isinstance(sweep.start, int) and isinstance(sweep.end, int) else "float"
        return _checked(Parameter(key, kind, sweep.start, sweep.end, log=log))
    values = list(sweep.range())
    if not values:
        raise ConfigError(f"{key}: the range holds no value.")
    if isinstance(values[0], int):
        return _checked(Parameter(key, "int", values[0], values[-1], sweep.step, log))
    return _checked(Parameter(key, "float", values[0], values[-1], sweep.step, log))


def override_text(value: Any) -> str:
    """Return a value as it is typed behind the ``=`` of an override.

    >>> override_text([1, None, "a b"])
    "[1,null,'a b']"
    """
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{k}:{override_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(map(override_text, value)) + "]"
    if isinstance(value, str) and not re.fullmatch(r"[A-Za-z_][\w./-]*", value):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return str(value)


def _parse_entry(key: str, entry: Any) -> Parameter:
    if not isinstance(entry, Mapping):
        raise ConfigError(f"search_space: '{key}' needs a type and its bounds or choices.")
    for name in entry:
        if name not in _ENTRY_KEYS:
            raise ConfigError(
                f"search_space: '{key}' has an unknown entry '{name}'."
                f"{did_you_mean(str(name), _ENTRY_KEYS)} There are {', '.join(_ENTRY_KEYS)}."
            )
    kind = entry.get("type")
    if kind not in KINDS:
        raise ConfigError(
            f"search_space: the type of '{key}' must be {', '.join(KINDS)}, but it is {kind!r}."
        )
    return _checked(
        Parameter(
            key,
            kind,
            low=entry.get("low"),
            high=entry.get("high"),
            step=entry.get("step"),
            log=bool(entry.get("log", False)),
            choices=tuple(entry.get("choices") or ()),
            when={str(name).lstrip("+"): v for name, v in (entry.get("when") or {}).items()},
        )
    )


def _checked(parameter: Parameter) -> Parameter:
    problem = _problem(parameter)
    if problem:
        raise ConfigError(f"search_space: '{parameter.key}' {problem}.")
    return parameter


def _problem(p: Parameter) -> str:
    if p.kind == "categorical":
        return "" if p.choices else "is categorical and needs choices"
    numbers = [n for n in (p.low, p.high, p.step) if n is not None]
    if p.low is None or p.high is None:
        return "needs low and high"
    if any(isinstance(n, bool) or not isinstance(n, (int, float)) for n in numbers):
        return "needs numbers as bounds"
    if not all(map(math.isfinite, numbers)) or p.low > p.high:
        return f"needs finite bounds with low <= high, but they are {p.low} and {p.high}"
    if p.step is not None and p.step <= 0:
        return f"needs a step above 0, but it is {p.step}"
    if p.log and (p.low <= 0 or (p.step or 1) != 1 or (p.kind == "float" and p.step)):
        return "is logarithmic, which needs low > 0 and no step"
    if p.kind == "int" and any(float(n) != int(n) for n in numbers):
        return "is int and needs whole numbers"
    return ""
