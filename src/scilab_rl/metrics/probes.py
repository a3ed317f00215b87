"""Quantities of the agent for one step, which are shown next to the scene.

A probe is a function of the step, and takes as many of these as it needs, in this order::

    (algorithm, observation, action, reward, next_observation, info, done, terminated)

It returns a number, several numbers by name, or None where there is nothing to say. Observations
and actions are those of the environment, without a batch dimension; ``next_observation`` is the
last one of the episode where ``done`` is true, and that one is a terminal state, without a future,
where ``terminated`` is true.

Write your own in ``src/custom_probes.py`` and give its name to a run:
``render_metrics_train=[custom_probes.surprise]``. A class is instantiated for each episode, so that
it can keep state.
"""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.metrics.logger import as_number
from scilab_rl.metrics.names import is_recorded, refuse_absent
from scilab_rl.metrics.success import success_of

ARGUMENTS = (
    "algorithm", "observation", "action", "reward", "next_observation", "info", "done",
    "terminated",
)  # fmt: skip
SECOND_CRITIC = "second critic"  # a quantity of algorithms with more than one
_SCENE_ARGUMENTS = 2  # what is known of the last scene of an episode, in which nothing is done


Observation = np.ndarray | dict[str, np.ndarray]


class Curve(NamedTuple):
    """A line in a panel.

    Attributes:
        panel: The metric.
        label: Which of its numbers; empty for a metric that is one number.
    """

    panel: str
    label: str = ""


class Inspectable(Protocol):
    """The quantities of an algorithm for probes, see `scilab_rl.learning.inspector`."""

    quantities: frozenset[str]

    @property
    def algorithm(self) -> object:
        """The algorithm."""

    @property
    def gamma(self) -> float:
        """The discount factor."""

    def q_values(self, observation: Observation, action: np.ndarray) -> np.ndarray:
        """The value of an action for each critic. Shapes: result ``(n_critics,)``."""

    def value(self, observation: Observation) -> float:
        """The value of an observation."""

    def log_prob(self, observation: Observation, action: np.ndarray) -> float:
        """The log probability of an action."""

    def entropy(self, observation: Observation) -> float:
        """The entropy of the policy, in nats."""

    def similarity(self, observation: Observation, action: np.ndarray) -> float:
        """How similar a step and the desired goal are."""

    def steps_to_goal(self, observation: Observation, action: np.ndarray) -> float:
        """How many steps away the desired goal is thought to be."""

    def intrinsic_reward(
        self, observation: Observation, action: np.ndarray, next_observation: Observation
    ) -> float:
        """The reward that the algorithm gives itself."""

    def learned_reward(self, reward: float) -> float:
        """A reward in the scale that the critics learn."""

    def after(self, observation: Observation) -> Inspectable:
        """The same for the next step: a recurrent policy remembers the observation."""


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
    make: Callable[[], Callable[..., object]]
    n_arguments: int
    needs: frozenset[str] = frozenset()

    @property
    def describes_scene(self) -> bool:
        """Whether it can be asked about the last scene of an episode, without an action."""
        return self.n_arguments <= _SCENE_ARGUMENTS


@dataclass(frozen=True)
class ShownMetrics:
    """The metrics that are shown next to the scene.

    Attributes:
        names: One panel each, in the user's order.
        probes: Those that are computed.
        recorded: Those that the algorithm records with ``self.logger.record``.
    """

    names: tuple[str, ...] = ()
    probes: tuple[Probe, ...] = ()
    recorded: tuple[str, ...] = ()


def q_value(inspector: Inspectable, observation: Observation, action: np.ndarray) -> float:
    """Q(s, a): the mean over the critics."""
    return float(inspector.q_values(observation, action).mean())


def q_values(
    inspector: Inspectable, observation: Observation, action: np.ndarray
) -> dict[str, float]:
    """Q(s, a) of each critic."""
    return _numbered(inspector.q_values(observation, action))


def critic_variance(
    inspector: Inspectable, observation: Observation, action: np.ndarray
) -> float | None:
    """How much the critics disagree: the mean squared deviation of Q_i(s, a) from their mean.

    A single critic has no variance.
    """
    values = inspector.q_values(observation, action).astype(np.float64)
    return float(np.var(values)) if len(values) > 1 else None


def value(inspector: Inspectable, observation: Observation) -> float:
    """V(s): the value network, or the mean over the critics of Q(s, pi(s))."""
    return inspector.value(observation)


def td_error(
    inspector: Inspectable,
    observation: Observation,
    action: np.ndarray,
    reward: float,
    next_observation: Observation,
    info: Mapping[str, object],
    done: bool,
    terminated: bool,
) -> float:
    """The surprise r + gamma V(s') - Q(s, a), or - V(s) for algorithms without action values.

    A terminal state has no value; one where the episode was only cut off (truncated) has.
    """
    later = inspector.after(observation)
    future = 0.0 if terminated else inspector.gamma * later.value(next_observation)
    if "q_values" in inspector.quantities:
        expected = q_value(inspector, observation, action)
    else:
        expected = inspector.value(observation)
    return inspector.learned_reward(reward) + future - expected


def entropy(inspector: Inspectable, observation: Observation) -> float:
    """H(pi(. | s)) in nats."""
    return inspector.entropy(observation)


def log_prob(inspector: Inspectable, observation: Observation, action: np.ndarray) -> float:
    """Log pi(a | s) in nats."""
    return inspector.log_prob(observation, action)


def similarity(inspector: Inspectable, observation: Observation, action: np.ndarray) -> float:
    """f(s, a, g): how similar a step and the desired goal are, to a contrastive critic."""
    return inspector.similarity(observation, action)


def steps_to_goal(inspector: Inspectable, observation: Observation, action: np.ndarray) -> float:
    """How many steps away a contrastive critic thinks that the desired goal is."""
    return inspector.steps_to_goal(observation, action)


def reward(
    inspector: Inspectable, observation: Observation, action: np.ndarray, reward: float
) -> float:
    """The reward of the environment for this action."""
    return reward + 0.0  # never -0


class ReturnSoFar:
    """The sum of the rewards of the episode, this one included."""

    def __init__(self) -> None:
        self.total = 0.0

    def __call__(
        self, inspector: Inspectable, observation: Observation, action: np.ndarray, reward: float
    ) -> float:
        """Add a reward."""
        self.total += reward
        return self.total


def intrinsic_reward(
    inspector: Inspectable,
    observation: Observation,
    action: np.ndarray,
    reward: float,
    next_observation: Observation,
) -> float:
    """The intrinsic reward for this action."""
    return inspector.intrinsic_reward(observation, action, next_observation)


def goal_distance(inspector: Inspectable, observation: Observation) -> float:
    """The Euclidean distance of the achieved goal from the desired one, in the task's units."""
    return float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))


def action(
    inspector: Inspectable, observation: Observation, action: np.ndarray
) -> dict[str, float] | float:
    """Each dimension of the action."""
    values = np.asarray(action, dtype=np.float64).ravel()
    return _numbered(values) if np.ndim(action) else float(values[0])


def success(
    inspector: Inspectable,
    observation: Observation,
    action: np.ndarray,
    reward: float,
    next_observation: Observation,
    info: Mapping[str, object],
) -> float | None:
    """1 when the action led to success, 0 when not."""
    reached = success_of(info)
    return None if reached is None else float(reached)


# name -> (function or class, quantities that the algorithm must answer)
_PROBES: dict[str, tuple[Callable[..., object], frozenset[str]]] = {
    "q_value": (q_value, frozenset({"q_values"})),
    "q_values": (q_values, frozenset({"q_values"})),
    "critic_variance": (critic_variance, frozenset({"q_values", SECOND_CRITIC})),
    "value": (value, frozenset({"value"})),
    "td_error": (td_error, frozenset({"value"})),
    "entropy": (entropy, frozenset({"entropy"})),
    "log_prob": (log_prob, frozenset({"log_prob"})),
    "similarity": (similarity, frozenset({"similarity"})),
    "steps_to_goal": (steps_to_goal, frozenset({"steps_to_goal"})),
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
    """Return whether this is the name of a built-in probe."""
    return name in _PROBES or name in _ALIASES


def meaning_of(name: str) -> str:
    """Return in one sentence what a metric means; empty for those of the user.

    >>> meaning_of("q_values"), meaning_of("custom_probes.surprise")
    ('Q(s, a) of each critic.', '')
    """
    if is_known(name):
        return (inspect.getdoc(_PROBES[_ALIASES.get(name, name)][0]) or "").partition("\n")[0]
    return "Recorded by the algorithm while it learns." if "/" in name else ""


def answerable(inspector: Inspectable) -> list[str]:
    """Return the names of the probes that an algorithm can answer."""
    return [name for name, (_, needs) in _PROBES.items() if needs <= inspector.quantities]


def resolve_metrics(
    names: Sequence[str],
    inspector: Inspectable,
    recorded: Iterable[str],
    *,
    key: str,
    algorithm_name: str,
    absent: Mapping[str, str] | None = None,
    hint: Callable[[str], str] = lambda name: "",
) -> ShownMetrics:
    """Find out how each metric of a ``render_metrics_*`` list is obtained.

    Args:
        names: Probes, ``module.function`` of the user, and names that the algorithm records.
        inspector: The algorithm.
        recorded: Names that the algorithm is known to record, or patterns such as ``train/*``.
        key: The key of the list, for messages.
        algorithm_name: The algorithm's name, for messages.
        absent: Names that it records in other configurations, and in which.
        hint: Returns what else can be done about an unknown name.

    Raises:
        ConfigError: If a name is unknown or the algorithm cannot answer a probe.
    """
    known = set(recorded)
    probes: list[Probe] = []
    logged: list[str] = []
    for name in dict.fromkeys(names):
        if is_known(name):
            probe = built_in(name)
            _check_answerable(probe, inspector, key, algorithm_name)
            probes.append(probe)
        elif "." in name and "/" not in name:
            probes.append(_custom(name, key))
        elif is_recorded(name, known):
            logged.append(name)
        else:
            refuse_absent(key, name, absent or {}, algorithm_name)
            words = [*_PROBES, *_ALIASES, *(word for word in known if "*" not in word)]
            raise ConfigError(
                f"{key}: there is no metric '{name}'.{did_you_mean(name, words)} "
                f"Probes of {algorithm_name}: "
                f"{', '.join(answerable(inspector))}. It records: {listing(known) or 'nothing'}. "
                f"Your own: custom_probes.FUNCTION.{hint(name)}"
            )
    return ShownMetrics(tuple(dict.fromkeys(names)), tuple(probes), tuple(logged))


@dataclass
class EpisodeProbes:
    """The probes of one episode, with what they remember.

    A probe that fails is reported once by ``warn`` and is then a gap.
    """

    inspector: Inspectable
    probes: Iterable[Probe]
    warn: Callable[[str], object]
    _functions: list[tuple[Probe, Callable[..., object]]] = field(init=False)

    def __post_init__(self) -> None:
        self._functions = [(probe, probe.make()) for probe in self.probes]

    def of_step(self, observation: Observation, *arguments: object) -> dict[Curve, float]:
        """Return the values of a step, given what follows the algorithm in `ARGUMENTS`.

        Steps come in the order of the episode, so that a recurrent policy remembers them.
        """
        values = self._values(self._functions, (observation, *arguments))
        self.inspector = self.inspector.after(observation)
        return values

    def of_scene(self, observation: Observation) -> dict[Curve, float]:
        """Return what can be said of the last scene, in which nothing is done any more."""
        functions = [entry for entry in self._functions if entry[0].describes_scene]
        return self._values(functions, (observation,))

    def _values(
        self, functions: list[tuple[Probe, Callable[..., object]]], arguments: tuple[object, ...]
    ) -> dict[Curve, float]:
        values: dict[Curve, float] = {}
        for probe, function in functions:
            try:
                answer = function(self.inspector, *arguments[: probe.n_arguments - 1])
                values |= as_curves(probe.name, answer)
            except Exception as error:  # noqa: BLE001 - a user's probe must not end the training
                self.warn(f"The metric {probe.name} failed: {type(error).__name__}: {error}")
                self._functions = [entry for entry in self._functions if entry[0] != probe]
        return values


def as_curves(name: str, answer: object) -> dict[Curve, float]:
    """Return the numbers of an answer by their curves; what is not finite is a gap.

    >>> as_curves("q_values", {"0": 1.5, "1": float("nan")})
    {Curve(panel='q_values', label='0'): 1.5}
    >>> as_curves("success", None)
    {}
    """
    numbers = answer if isinstance(answer, Mapping) else {"": answer}
    return {
        Curve(name, str(label)): number
        for label, value in numbers.items()
        if (number := as_number(value)) is not None and math.isfinite(number)
    }


def _numbered(values: Iterable[float]) -> dict[str, float]:
    return {str(index): float(number) for index, number in enumerate(values)}


def _maker(function: Callable[..., object]) -> Callable[[], Callable[..., object]]:
    """Return how to get the function for an episode: a class is instantiated for each."""
    if inspect.isclass(function):
        made: Callable[[], Any] = function
        return made
    return lambda: function


def _n_arguments(function: Callable[..., object]) -> int:
    is_class = inspect.isclass(function)
    called = vars(function)["__call__"] if is_class else function
    parameters = list(inspect.signature(called).parameters.values())[is_class:]
    if any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters):
        return len(ARGUMENTS)
    return len([p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)])


def _check_answerable(probe: Probe, inspector: Inspectable, key: str, algorithm_name: str) -> None:
    missing = probe.needs - inspector.quantities
    if missing and (reason := getattr(inspector, "reason", "")):
        raise ConfigError(f"{key}: '{probe.name}' cannot be asked here. {reason}")
    if missing:
        raise ConfigError(
            f"{key}: {algorithm_name} cannot answer '{probe.name}', because it has no "
            f"{listing(missing)} here. It can answer: {', '.join(answerable(inspector))}."
            + (" Give it two critics or more (n_critics)." * (missing == {SECOND_CRITIC}))
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

    def make_for_algorithm() -> Callable[..., object]:
        function = make()
        return lambda inspector, *rest: function(inspector.algorithm, *rest)

    return Probe(name, make_for_algorithm, n_arguments)
