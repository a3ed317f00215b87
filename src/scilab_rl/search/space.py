"""The search space: Optuna's distributions, the settings that they allow, and their overrides.

A *setting* is one point of the space: parameter name to value. Values are compared as values, see
`same_value`, and ranges are counted, never listed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.search.definition import ParameterDescription
from scilab_rl.search.values import is_number, override_text, same_value

if TYPE_CHECKING:
    import optuna

Setting = dict[str, Any]
Label = bool | int | float | str | None  # of a choice, as Optuna stores it
_ABSENT = object()
_OTHER = object()  # any value that no condition names
_SCALARS = (bool, int, float, str, type(None))
_MOST_SHOWN = 12


@dataclass(frozen=True)
class Parameter:
    """One dimension of the search space.

    Attributes:
        key: What stands before the ``=`` of the override, for example ``++algorithm.gamma``.
        kind: ``float``, ``int`` or ``categorical``.
        low: Smallest value, inclusive.
        high: Largest value, inclusive; one of the steps.
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
    choices: tuple[object, ...] = ()
    when: Mapping[str, object] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The key without plus signs."""
        return self.key.lstrip("+")

    @property
    def labels(self) -> tuple[Label, ...]:
        """The choices as Optuna stores them: numbers, words, and lists as they are typed.

        Where two of these would be equal in Python (1 and true, [1] and '[1]'), all are typed.
        """
        plain = tuple(c if isinstance(c, _SCALARS) else override_text(c) for c in self.choices)
        return plain if len({*plain}) == len(plain) else tuple(map(override_text, self.choices))

    @property
    def domain(self) -> str:
        """The values as a message shows them."""
        if self.kind == "categorical":
            shown = ", ".join(map(override_text, self.choices[:_MOST_SHOWN]))
            return shown + (", ..." if len(self.choices) > _MOST_SHOWN else "")
        step = f" in steps of {self.step}" if self.step and self.step != 1 else ""
        whole = "whole numbers " if self.kind == "int" and not step else ""
        return f"{whole}from {self.low} to {self.high}{step}"

    def override(self, value: object) -> str:
        """Return the override that sets this parameter to one of its values."""
        if self.kind == "categorical":
            value = self.choices[self.labels.index(value)]
        return f"{self.key}={override_text(value)}"

    def exists_in(self, setting: Setting) -> bool:
        """Return whether the parameter exists, given the values of the parameters before it."""
        return all(same_value(setting.get(name, _ABSENT), v) for name, v in self.when.items())

    def suggest(self, trial: optuna.Trial) -> object:
        """Ask the sampler for a value."""
        if self.kind == "categorical":
            return trial.suggest_categorical(self.name, self.labels)
        low, high = self._bounds()
        if self.kind == "int":
            step = int(self.step or 1)
            return trial.suggest_int(self.name, int(low), int(high), step=step, log=self.log)
        return trial.suggest_float(self.name, low, high, step=self.step, log=self.log)

    def count(self) -> float:
        """Return how many values there are; infinite for a continuum."""
        if self.kind == "categorical":
            return len(self.choices)
        low, high = self._bounds()
        if self._spacing is None:
            return 1 if low == high else math.inf
        return n_steps(low, high, self._spacing) + 1

    def values(self) -> Iterator[object]:
        """Yield all values, as Optuna stores them, of a parameter that is not continuous."""
        if self.kind == "categorical":
            yield from self.labels
            return
        for index in range(int(self.count())):
            yield self._at(index)

    def own(self, value: object) -> Sequence[object]:
        """Return the value as the parameter has it, in a list that is empty when it has not."""
        if self.kind == "categorical":
            pairs = zip(self.choices, self.labels, strict=True)
            return [label for choice, label in pairs if same_value(choice, value)][:1]
        low, high = self._bounds()
        if not is_number(value) or not math.isfinite(value):
            return []
        if self._spacing is None:
            return [value] if low <= value <= high else []
        index = round((value - low) / self._spacing)
        fits = 0 <= index < self.count() and math.isclose(
            self._at(index), value, rel_tol=1e-9, abs_tol=1e-8 * self._spacing
        )
        return [self._at(index)] if fits else []

    def place(self, stored: object) -> object:
        """Return what tells two stored values apart, or None if the parameter has no such value.

        A sampler's 0.30000000000000004 and a list's 0.3 are the same step.
        """
        if self.kind == "categorical":
            return self.labels.index(stored) if stored in self.labels else None
        return next(iter(self.own(stored)), None)

    def describe(self) -> ParameterDescription:
        """Return what can be written as JSON and compared."""
        empty = ("None", "False", "()", "{}")  # but not 0, which is a bound
        described: Any = {k: v for k, v in asdict(self).items() if repr(v) not in empty}
        if self.choices:
            described["choices"] = list(self.labels)
        if self.choices != self.labels:
            described["values"] = list(self.choices)
        return described

    @property
    def _spacing(self) -> float | None:
        return self.step or (1 if self.kind == "int" else None)

    def _bounds(self) -> tuple[float, float]:
        assert self.low is not None and self.high is not None
        return self.low, self.high

    def _at(self, index: int) -> float:
        """Return a value by its number of steps from the lowest, as one would write it."""
        low, _ = self._bounds()
        spacing = self._spacing
        assert spacing is not None
        if self.kind == "int":
            return int(low) + index * int(spacing)
        return float(Decimal(str(low)) + index * Decimal(str(spacing)))


def n_steps(low: float, high: float, step: float) -> int:
    """Return how many steps lead from the lowest value to the last one that is not too high."""
    return int((Decimal(str(high)) - Decimal(str(low))) // Decimal(str(step)))


class SearchSpace:
    """All parameters, in the order in which they are drawn.

    Args:
        parameters: The parameters; one that depends on others comes after them.
        fixed: Values of the configuration that are not searched, on which parameters may depend.

    Raises:
        ConfigError: If a parameter is given twice, or could never exist.
    """

    def __init__(
        self, parameters: Sequence[Parameter], fixed: Mapping[str, object] | None = None
    ) -> None:
        self.parameters: list[Parameter] = []
        names = [parameter.name for parameter in parameters]
        for i, parameter in enumerate(parameters):
            if parameter.name in names[:i]:
                raise ConfigError(f"search_space: '{parameter.name}' is given twice.")
            self.parameters.append(self._resolved(parameter, names, fixed or {}))
            self._needs(parameter.name)

    def suggest(self, trial: optuna.Trial) -> Setting:
        """Let the sampler of the trial's study choose a setting."""
        setting: Setting = {}
        for parameter in self.parameters:
            if parameter.exists_in(setting):
                setting[parameter.name] = parameter.suggest(trial)
        return setting

    def setting_in(self, values: Mapping[str, object]) -> Setting | None:
        """Return the setting that a configuration has, or None where the space does not hold it.

        Args:
            values: Name to value, as in `scilab_rl.config.schema.flat`.
        """
        setting: Setting = {}
        for parameter in self.parameters:
            if parameter.exists_in(setting):
                if not (own := parameter.own(values.get(parameter.name, _ABSENT))):
                    return None
                setting[parameter.name] = own[0]
        return setting

    def identity(self, setting: Mapping[str, object]) -> tuple[object, ...] | None:
        """Return what equal settings share, or None for a configuration outside this space."""
        places: list[tuple[str, object]] = []
        for parameter in self.parameters:
            if parameter.exists_in(dict(setting)):
                places.append((parameter.name, parameter.place(setting.get(parameter.name))))
        known = len(places) == len(setting) and all(p is not None for _, p in places)
        return tuple(places) if known else None

    def overrides(self, setting: Setting) -> list[str]:
        """Return the overrides that make a run use this setting."""
        return [p.override(setting[p.name]) for p in self.parameters if p.name in setting]

    def all_settings(self, setting: Setting | None = None) -> Iterator[Setting]:
        """Yield each setting of a finite space once, the last parameter changing fastest.

        Args:
            setting: Values of the first parameters, from which to continue.
        """
        setting = setting or {}
        following = (p for p in self.parameters if p.name not in setting and p.exists_in(setting))
        parameter = next(following, None)
        if parameter is None:
            yield dict(setting)
            return
        for value in parameter.values():
            yield from self.all_settings({**setting, parameter.name: value})

    def size(self) -> float:
        """Return how many settings there are; infinite with a continuous parameter."""
        return self._size(0, {})

    def refuse_continuum(self) -> None:
        """Reject a space whose settings cannot be tried one after the other.

        Raises:
            ConfigError: If a parameter is continuous.
        """
        for parameter in self.parameters:
            if math.isinf(parameter.count()):
                raise ConfigError(
                    f"search_space: '{parameter.name}' has infinitely many values; give it a step "
                    "or choices, or take another sampler than grid."
                )

    def describe(self) -> dict[str, ParameterDescription]:
        """Return what can be written as JSON and compared."""
        return {parameter.name: parameter.describe() for parameter in self.parameters}

    def _size(self, index: int, setting: Setting) -> float:
        if index == len(self.parameters):
            return 1
        parameter = self.parameters[index]
        if not parameter.exists_in(setting):
            return self._size(index + 1, setting)
        named = self._named_in_conditions(parameter)
        total = sum(self._size(index + 1, {**setting, parameter.name: v}) for v in named)
        n_others = parameter.count() - len(named)
        if n_others:
            total += n_others * self._size(index + 1, {**setting, parameter.name: _OTHER})
        return total

    def _named_in_conditions(self, parameter: Parameter) -> list[object]:
        named: list[object] = []
        for other in self.parameters:
            value = other.when.get(parameter.name, _ABSENT)
            if value is not _ABSENT and not any(same_value(value, v) for v in named):
                named.append(value)
        return named

    def _resolved(
        self, parameter: Parameter, names: Sequence[str], fixed: Mapping[str, object]
    ) -> Parameter:
        """Return the parameter with its conditions as the parameters that they name have them."""
        when = {}
        for name, value in parameter.when.items():
            parent = next((p for p in self.parameters if p.name == name), None)
            if parent is not None:
                when[name] = self._own_value(parameter, parent, value)
            elif name in fixed and name not in names:
                _refuse_other_value(parameter, name, value, fixed[name])
            else:
                raise ConfigError(
                    f"search_space: '{parameter.name}' exists when '{name}' has a value, so "
                    f"'{name}' must come before it.{did_you_mean(name, [*names, *fixed])}"
                )
        return replace(parameter, when=when)

    def _own_value(self, parameter: Parameter, parent: Parameter, value: object) -> object:
        if own := parent.own(value):
            return own[0]
        given, words = override_text(value), map(override_text, parent.choices)
        raise ConfigError(
            f"search_space: '{parameter.name}' exists when '{parent.name}' is {given}, which it "
            f"never is.{did_you_mean(given, words)} '{parent.name}' can be {parent.domain}."
        )

    def _needs(self, name: str) -> dict[str, object]:
        """Return the values that others must have where a parameter exists; refuse two of one."""
        when = next(p.when for p in self.parameters if p.name == name)
        needs = dict(when)
        for parent in when:
            for other, value in self._needs(parent).items():
                if not same_value(needs.setdefault(other, value), value):
                    raise ConfigError(
                        f"search_space: '{name}' can never exist: it needs '{other}' to be "
                        f"{override_text(needs[other])}, and '{parent}', on which it depends, "
                        f"needs it to be {override_text(value)}."
                    )
        return needs


def _refuse_other_value(parameter: Parameter, name: str, wanted: object, fixed: object) -> None:
    given, always = override_text(wanted), override_text(fixed)
    if not same_value(fixed, wanted):
        raise ConfigError(
            f"search_space: '{parameter.name}' exists when '{name}' is {given}, but '{name}' is "
            f"not searched and always {always}.{did_you_mean(given, [always])} Search '{name}' "
            f"too, or give '{parameter.name}' a value on the command line."
        )
