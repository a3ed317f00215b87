"""Quantities of the agent's inside for one step: what is drawn beside the scene.

A probe is a function of the step, and takes as many of these as it needs, in this order::

    (algorithm, observation, action, reward, next_observation, info, done)

It returns a number, several numbers by name, or None where there is nothing to say. Observations
and actions are those of the environment, without a batch dimension; ``next_observation`` is the
last one of the episode where ``done`` is true.

Write your own in ``src/custom_probes.py`` and give its name to a run:
``render_metrics_train=[custom_probes.surprise]``. A class is made anew for each episode, so that it
can remember what has been.
"""

from __future__ import annotations

import fnmatch
import importlib
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.metrics.logger import as_number
from scilab_rl.metrics.success import success_of

ARGUMENTS = (
    "algorithm",
    "observation",
    "action",
    "reward",
    "next_observation",
    "info",
    "done",
)
_SCENE_ARGUMENTS = 2  # what is known of the last scene of an episode, in which nothing is done


class Inspectable(Protocol):
    """What probes ask about an algorithm; `scilab_rl.algorithms.inspection` answers."""

    algorithm: Any
    quantities: frozenset[str]

    @property
    def gamma(self) -> float:
        """The discount factor."""

    def q_values(self, observation: Any, action: Any) -> np.ndarray:
        """What each critic says about an action. Shapes: result ``(n_critics,)``."""

    def value(self, observation: Any) -> float:
        """The value of an observation."""

    def log_prob(self, observation: Any, action: Any) -> float:
        """The log probability of an action."""

    def entropy(self, observation: Any) -> float:
        """The entropy of the policy, in nats."""

    def intrinsic_reward(self, observation: Any, action: Any, next_observation: Any) -> float:
        """The reward that the algorithm gives itself."""

    def learned_reward(self, reward: float) -> float:
        """A reward in the scale that the critics learn."""


@dataclass(frozen=True)
class Probe:
    """A metric that is computed for the very step that is shown.

    Attributes:
        name: As in ``render_metrics_*``.
        make: Returns the function for one episode; its first argument is an `Inspectable`.
        n_arguments: How many of `ARGUMENTS` the function takes.
        needs: Quantities that the algorithm must be able to answer.
    """

    name: str
    make: Callable[[], Callable[..., Any]]
    n_arguments: int
    needs: frozenset[str] = frozenset()

    @property
    def describes_scene(self) -> bool:
        """Whether it can be asked about the last scene of an episode, without an action."""
        return self.n_arguments <= _SCENE_ARGUMENTS


@dataclass(frozen=True)
class ShownMetrics:
    """What is shown beside the scene.

    Attributes:
        names: One panel each, in the user's order.
        probes: Those that are computed.
        recorded: Those that the algorithm records with ``self.logger.record``.
    """

    names: tuple[str, ...] = ()
    probes: tuple[Probe, ...] = ()
    recorded: tuple[str, ...] = ()


def q_value(mind: Inspectable, observation: Any, action: Any) -> float:
    """Q(s, a): the mean over the critics."""
    return float(mind.q_values(observation, action).mean())


def q_values(mind: Inspectable, observation: Any, action: Any) -> dict[str, float]:
    """Q(s, a) of each critic."""
    return _numbered(mind.q_values(observation, action))


def critic_variance(mind: Inspectable, observation: Any, action: Any) -> float:
    """How much the critics disagree: the mean squared deviation of Q_i(s, a) from their mean."""
    return float(np.var(mind.q_values(observation, action).astype(np.float64)))


def value(mind: Inspectable, observation: Any) -> float:
    """V(s): the value network, or the mean over the critics of Q(s, pi(s))."""
    return mind.value(observation)


def td_error(
    mind: Inspectable,
    observation: Any,
    action: Any,
    reward: float,
    next_observation: Any,
    info: Mapping[str, Any],
    done: bool,
) -> float:
    """The surprise r + gamma V(s') - Q(s, a), or - V(s) for algorithms without action values.

    A terminal state has no value; one where the episode was only cut off (truncated) has.
    """
    terminated = done and not info.get("TimeLimit.truncated", False)
    future = 0.0 if terminated else mind.gamma * mind.value(next_observation)
    if "q_values" in mind.quantities:
        expected = q_value(mind, observation, action)
    else:
        expected = mind.value(observation)
    return mind.learned_reward(reward) + future - expected


def entropy(mind: Inspectable, observation: Any) -> float:
    """H(pi(. | s)) in nats."""
    return mind.entropy(observation)


def log_prob(mind: Inspectable, observation: Any, action: Any) -> float:
    """Log pi(a | s) in nats."""
    return mind.log_prob(observation, action)


def reward(mind: Inspectable, observation: Any, action: Any, reward: float) -> float:
    """What the environment gave for this action."""
    return reward + 0.0  # never -0


class ReturnSoFar:
    """The sum of the rewards of the episode, this one included."""

    def __init__(self) -> None:
        self.total = 0.0

    def __call__(self, mind: Inspectable, observation: Any, action: Any, reward: float) -> float:
        """Add a reward."""
        self.total += reward
        return self.total


def intrinsic_reward(
    mind: Inspectable, observation: Any, action: Any, reward: float, next_observation: Any
) -> float:
    """What the algorithm gave itself for this action."""
    return mind.intrinsic_reward(observation, action, next_observation)


def goal_distance(mind: Inspectable, observation: Any) -> float:
    """The Euclidean distance of the achieved goal from the desired one, in the task's units."""
    return float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))


def action(mind: Inspectable, observation: Any, action: Any) -> dict[str, float] | float:
    """Each dimension of the action."""
    values = np.asarray(action, dtype=np.float64).ravel()
    return _numbered(values) if np.ndim(action) else float(values[0])


def success(
    mind: Inspectable,
    observation: Any,
    action: Any,
    reward: float,
    next_observation: Any,
    info: Mapping[str, Any],
) -> float | None:
    """1 when the action led to success, 0 when not."""
    reached = success_of(info)
    return None if reached is None else float(reached)


# name -> (function or class, quantities that the algorithm must answer)
_PROBES: dict[str, tuple[Callable[..., Any], frozenset[str]]] = {
    "q_value": (q_value, frozenset({"q_values"})),
    "q_values": (q_values, frozenset({"q_values"})),
    "critic_variance": (critic_variance, frozenset({"q_values"})),
    "value": (value, frozenset({"value"})),
    "td_error": (td_error, frozenset({"value"})),
    "entropy": (entropy, frozenset({"entropy"})),
    "log_prob": (log_prob, frozenset({"log_prob"})),
    "reward": (reward, frozenset()),
    "return_so_far": (ReturnSoFar, frozenset()),
    "intrinsic_reward": (intrinsic_reward, frozenset({"intrinsic_reward"})),
    "goal_distance": (goal_distance, frozenset({"goals"})),
    "action": (action, frozenset()),
    "success": (success, frozenset()),
}
PROBE_NAMES = tuple(_PROBES)
# The environment knows the reward of a step, whatever an algorithm records.
_ALIASES = {f"{section}/rollout_rewards_step": "reward" for section in ("train", "eval", "rollout")}


def built_in(name: str) -> Probe:
    """Return a built-in probe; ``train/rollout_rewards_step`` is the reward's name in the paper."""
    function, needs = _PROBES[_ALIASES.get(name, name)]
    return Probe(name, _maker(function), _n_arguments(function), needs)


def is_known(name: str) -> bool:
    """Tell whether this is the name of a built-in probe."""
    return name in _PROBES or name in _ALIASES


def answerable(mind: Inspectable) -> list[str]:
    """Return the names of the probes that an algorithm can answer."""
    return [name for name, (_, needs) in _PROBES.items() if needs <= mind.quantities]


def resolve_metrics(
    names: Sequence[str], mind: Inspectable, recorded: Iterable[str], *, key: str, who: str
) -> ShownMetrics:
    """Find out how each metric of a ``render_metrics_*`` list is obtained.

    Args:
        names: Probes, ``module.function`` of the user, and names that the algorithm records.
        mind: The algorithm.
        recorded: Names that the algorithm is known to record, or patterns such as ``train/*``.
        key: The key of the list, for messages.
        who: The algorithm's name, for messages.

    Raises:
        ConfigError: If a name is unknown or the algorithm cannot answer a probe.
    """
    known = set(recorded)
    probes: list[Probe] = []
    logged: list[str] = []
    for name in dict.fromkeys(names):
        if is_known(name):
            probe = built_in(name)
            _check_answerable(probe, mind, key, who)
            probes.append(probe)
        elif "." in name and "/" not in name:
            probes.append(_custom(name, key))
        elif any(fnmatch.fnmatchcase(name, pattern) for pattern in known):
            logged.append(name)
        else:
            words = [*_PROBES, *_ALIASES, *(word for word in known if "*" not in word)]
            raise ConfigError(
                f"{key}: there is no metric '{name}'.{did_you_mean(name, words)} Probes of {who}: "
                f"{', '.join(answerable(mind))}. It records: {listing(known) or 'nothing'}. "
                "Your own: custom_probes.FUNCTION."
            )
    return ShownMetrics(tuple(dict.fromkeys(names)), tuple(probes), tuple(logged))


@dataclass
class EpisodeProbes:
    """The probes of one episode, with what they remember.

    A probe that fails is reported once by ``warn`` and is then a gap.
    """

    mind: Inspectable
    probes: Iterable[Probe]
    warn: Callable[[str], object]
    _functions: list[tuple[Probe, Callable[..., Any]]] = field(init=False)

    def __post_init__(self) -> None:
        self._functions = [(probe, probe.make()) for probe in self.probes]

    def of_step(self, *arguments: Any) -> dict[str, float]:
        """Return the values of a step, given what follows the algorithm in `ARGUMENTS`."""
        return self._values(self._functions, arguments)

    def of_scene(self, observation: Any) -> dict[str, float]:
        """Return what can be said of the last scene, in which nothing is done any more."""
        functions = [entry for entry in self._functions if entry[0].describes_scene]
        return self._values(functions, (observation,))

    def _values(
        self, functions: list[tuple[Probe, Callable[..., Any]]], arguments: tuple[Any, ...]
    ) -> dict[str, float]:
        values: dict[str, float] = {}
        for probe, function in functions:
            try:
                answer = function(self.mind, *arguments[: probe.n_arguments - 1])
                values |= as_curves(probe.name, answer)
            except Exception as error:  # noqa: BLE001 - a user's probe must not end the training
                self.warn(f"The metric {probe.name} failed: {type(error).__name__}: {error}")
                self._functions = [entry for entry in self._functions if entry[0] != probe]
        return values


def as_curves(name: str, answer: Any) -> dict[str, float]:
    """Return the numbers of an answer by the names of their curves; what is not finite is a gap.

    >>> as_curves("q_values", {"0": 1.5, "1": float("nan")})
    {'q_values[0]': 1.5}
    >>> as_curves("success", None)
    {}
    """
    if isinstance(answer, Mapping):
        named = {f"{name}[{label}]": as_number(number) for label, number in answer.items()}
    else:
        named = {name: as_number(answer)}
    return {
        curve: number
        for curve, number in named.items()
        if number is not None and math.isfinite(number)
    }


def _numbered(values: Iterable[Any]) -> dict[str, float]:
    return {str(index): float(number) for index, number in enumerate(values)}


def _maker(function: Callable[..., Any]) -> Callable[[], Callable[..., Any]]:
    """Return how to get the function for an episode: a class is made anew for each."""
    if inspect.isclass(function):
        made: Callable[[], Any] = function
        return made
    return lambda: function


def _n_arguments(function: Callable[..., Any]) -> int:
    is_class = inspect.isclass(function)
    called = vars(function)["__call__"] if is_class else function
    parameters = list(inspect.signature(called).parameters.values())[is_class:]
    if any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters):
        return len(ARGUMENTS)
    return len([p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)])


def _check_answerable(probe: Probe, mind: Inspectable, key: str, who: str) -> None:
    missing = probe.needs - mind.quantities
    if missing:
        raise ConfigError(
            f"{key}: {who} cannot answer '{probe.name}', because it has no {listing(missing)} "
            f"here. It can answer: {', '.join(answerable(mind))}."
        )


def _custom(name: str, key: str) -> Probe:
    """Import a probe of the user, ``module.function``."""
    module_name, _, function_name = name.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise ConfigError(
            f"{key}: '{name}' cannot be imported: {type(error).__name__}: {error}. The function in "
            "src/custom_probes.py is custom_probes.FUNCTION."
        ) from error
    own = getattr(module, function_name, None)
    if not callable(own):
        functions = [word for word, entry in vars(module).items() if callable(entry)]
        raise ConfigError(
            f"{key}: there is no '{function_name}' in {module_name}."
            f"{did_you_mean(function_name, functions)}"
        )
    n_arguments = _n_arguments(own)
    if not 1 <= n_arguments <= len(ARGUMENTS):
        raise ConfigError(
            f"{key}: {name} takes {n_arguments} arguments, but a probe takes the first of "
            f"({', '.join(ARGUMENTS)}), as many as it needs."
        )

    make = _maker(own)

    def make_for_algorithm() -> Callable[..., Any]:
        function = make()
        return lambda mind, *rest: function(mind.algorithm, *rest)

    return Probe(name, make_for_algorithm, n_arguments)
