"""Cognitive models: one definition of how choices follow from experience, to act and to be fitted.

A model is three pure functions in JAX: `initial` is what is known when a block begins, `update`
what a trial changes, `choose` the preferences among responses, whose softmax gives probabilities.
`advance` joins them to a step. Acting calls it once per step of the environment, and the likelihood
of people's choices scans it over their trials (Wilson & Collins, 2019, eLife 8).
"""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from scilab_rl.envs.choices.trial_space import TrialSpace
from scilab_rl.envs.types import Observation
from scilab_rl.errors import ConfigError
from scilab_rl.learning.base import OneFileAlgorithm, Recalled

Array = jax.Array | np.ndarray
Values = Mapping[str, Any]  # of parameters, by name
Memory = Any  # a tree of arrays


class Trial(NamedTuple):
    """A choice and what it has brought.

    Attributes:
        state: In which it was made.
        response: What was chosen.
        feedback: What it has brought, from -1 to 1.
        next_state: Where it has led.
    """

    state: Array
    response: Array
    feedback: Array
    next_state: Array


class Seen(NamedTuple):
    """What is seen before a choice.

    Attributes:
        state: The present state.
        response: The last response; any number where a block begins.
        feedback: What the last response has brought.
        is_first: Whether a block begins.
    """

    state: Array
    response: Array
    feedback: Array
    is_first: Array


@dataclass(frozen=True)
class Parameter:
    """A free parameter: its range, and what is known of it before data.

    Attributes:
        low: Lower bound.
        high: Upper bound; with a finite ``low`` and no upper bound, the real scale is logarithmic,
            with both bounds it is logistic.
        mean: Of its normal prior on the real scale.
        sd: Of that prior.
        spread_sd: Of the half-normal prior of the standard deviation between participants, on the
            real scale; None: as ``sd``.
    """

    low: float = -math.inf
    high: float = math.inf
    mean: float = 0.0
    sd: float = 1.0
    spread_sd: float | None = None

    def from_real(self, x: Any, xp: ModuleType = jnp) -> Any:
        """Return the parameter that belongs to any real number."""
        if math.isfinite(self.high):
            return self.low + (self.high - self.low) / (1.0 + xp.exp(-x))
        return self.low + xp.exp(x) if math.isfinite(self.low) else x

    def to_real(self, value: Any) -> Any:
        """Return the real number that belongs to a parameter inside of its bounds."""
        if math.isfinite(self.high):
            share = (np.asarray(value) - self.low) / (self.high - self.low)
            return np.log(share) - np.log1p(-share)
        return np.log(np.asarray(value) - self.low) if math.isfinite(self.low) else value


# A learning rate: nearly even between 0 and 1. An inverse temperature: half of them from 2 to 6.
RATE = Parameter(0.0, 1.0, mean=0.0, sd=1.5)
TEMPERATURE = Parameter(0.0, mean=1.25, sd=0.8)


class CognitiveModel(OneFileAlgorithm):
    """A model that acts in choice tasks as an algorithm. A subclass is its three functions.

    Everything that it knows is in its memory, which begins anew with each block. It trains nothing:
    its parameters are those of the configuration.

    Args:
        env: Vector environment to act in.
        seed: Of the choices and the environments; None: do not seed.
        device: Accepted for all algorithms; models compute on the CPU.
        **values: The parameters with which the model acts.

    Attributes:
        parameters: The free parameters, by name.
        n_stages: Choices per trial of the tasks that it is a model of.
        chooses_by_chance: Whether tables of its choices draw them from its probabilities.
        values: Their values for acting.
        memory: Of each environment. Shapes: ``(n_envs, ...)`` per leaf.
    """

    supported_action_spaces = (spaces.Discrete,)
    parameters: ClassVar[Mapping[str, Parameter]]
    n_stages: ClassVar[int] = 1
    chooses_by_chance: ClassVar[bool] = True

    def __init__(
        self, *, env: VecEnv, seed: int | None = None, device: str = "auto", **values: float
    ) -> None:
        super().__init__(env=env, seed=seed, device=device)
        space: Any = self.observation_space
        if problem := self.observation_problem(space):
            raise ConfigError(f"{type(self).__name__} cannot act here: {problem}")
        self._check_bounds(values)
        self.values = {name: np.float32(value) for name, value in values.items()}
        self.n_states: int = space.n_states
        self.memory = self.new_memory(self.n_envs)

    @staticmethod
    @abstractmethod
    def initial(parameters: Values, n_states: int, n_actions: int) -> Memory:
        """Return what is known when a block begins."""

    @staticmethod
    @abstractmethod
    def update(parameters: Values, memory: Memory, trial: Trial) -> Memory:
        """Return what is known after a trial."""

    @staticmethod
    @abstractmethod
    def choose(parameters: Values, memory: Memory, state: Array) -> Array:
        """Return the preferences among the responses. Shapes: ``(n_actions,)``."""

    @classmethod
    def observation_problem(cls, space: spaces.Space) -> str | None:
        """Return why the model cannot act on these observations, or None if it can."""
        if not isinstance(space, TrialSpace):
            return (
                "it is a cognitive model of choices, for Bandit, ProbabilisticReversal, TwoStep, "
                "Horizon, HiddenGoal, or an environment of your own with a TrialSpace."
            )
        if space.n_stages == cls.n_stages:
            return None
        needed = "hybrid is a model of two" if space.n_stages == 2 else "use env=TwoStep"
        return f"it models {cls.n_stages} choice(s) per trial, not {space.n_stages}; {needed}."

    def _check_bounds(self, values: Values) -> None:
        for name, value in values.items():
            low, high = self.parameters[name].low, self.parameters[name].high
            if not low <= value <= high:
                limits = f"at least {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"
                raise ConfigError(f"algorithm.{name} must be {limits}, but it is {value}.")

    def iterate(self, callback: BaseCallback) -> bool:
        """Make one choice in each environment."""
        callback.on_rollout_start()
        probabilities, memory = self._advance(self._last_obs, self.memory)
        if self.step(sample(probabilities), callback) is None:
            return False
        self.memory = memory
        callback.on_rollout_end()
        return True

    def choose_actions(
        self, observations: Observation, state: Recalled, deterministic: bool
    ) -> tuple[np.ndarray, Recalled]:
        """Choose, and return what is known now; without a state, only the last trial is known."""
        memory = self.new_memory(len(observations))
        if state is not None:
            memory = jax.tree.unflatten(jax.tree.structure(memory), state)
        probabilities, memory = self._advance(observations, memory)
        actions = probabilities.argmax(axis=1) if deterministic else sample(probabilities)
        return actions, tuple(jax.tree.leaves(memory))

    def act(self, observations: torch.Tensor, deterministic: bool) -> torch.Tensor:
        """Choose from the last trial alone."""
        actions, _ = self.predict(observations.cpu().numpy(), deterministic=deterministic)
        return torch.as_tensor(actions)

    def new_memory(self, n: int) -> Memory:
        """Return the memory of so many beginners."""
        one = beginner(type(self), self.n_states, self.n_actions)
        return jax.tree.map(lambda leaf: np.repeat(leaf[None], n, axis=0), one)

    def _advance(self, observations: Any, memory: Memory) -> tuple[np.ndarray, Memory]:
        space: Any = self.observation_space
        states, responses, feedback = space.decode(observations)
        seen = Seen(states, responses, feedback, responses < 0)
        step = compiled_step(type(self), self.n_states, self.n_actions)
        log_probabilities, memory = step(self.values, memory, seen)
        # Copies: an array of JAX would count as a weight.
        return np.exp(np.asarray(log_probabilities)), jax.tree.map(np.array, memory)


def begin(model: type[CognitiveModel], parameters: Values, n_states: int, n_actions: int) -> Memory:
    """Return the memory before the first observation: the model's, and the last state."""
    known = model.initial(parameters, n_states, n_actions)
    return {"known": jax.tree.map(jnp.asarray, known), "state": jnp.zeros((), int)}


@functools.cache
def beginner(model: type[CognitiveModel], n_states: int, n_actions: int) -> Memory:
    """Return the memory before the first observation, which that will replace, as NumPy arrays."""
    values = {name: p.from_real(p.mean, np) for name, p in model.parameters.items()}
    make = jax.jit(functools.partial(begin, model, n_states=n_states, n_actions=n_actions))
    return jax.tree.map(np.asarray, make(values))


def advance(
    model: type[CognitiveModel],
    n_states: int,
    n_actions: int,
    parameters: Values,
    memory: Memory,
    seen: Seen,
) -> tuple[Array, Memory]:
    """Learn from the last trial, if there was one, and return the probabilities of the responses.

    Args:
        model: The model.
        n_states: States of the task.
        n_actions: Responses of the task.
        parameters: By name.
        memory: From `begin` or the last call.
        seen: The present state and the last trial.

    Returns:
        Log-probabilities of the responses, and the memory.

    Shapes:
        result: ``(n_actions,)``.
    """
    trial = Trial(memory["state"], seen.response, seen.feedback, seen.state)
    fresh = model.initial(parameters, n_states, n_actions)
    learned = model.update(parameters, memory["known"], trial)
    known = jax.tree.map(lambda new, old: jnp.where(seen.is_first, new, old), fresh, learned)
    preferences = model.choose(parameters, known, seen.state)
    return jax.nn.log_softmax(preferences), {"known": known, "state": seen.state}


@functools.cache
def compiled_step(model: type[CognitiveModel], n_states: int, n_actions: int) -> Callable[..., Any]:
    """Return `advance` for a batch with the same parameters, compiled."""
    step = functools.partial(advance, model, n_states, n_actions)
    return jax.jit(jax.vmap(step, in_axes=(None, 0, 0)))


def log_probabilities(
    model: type[CognitiveModel],
    n_states: int,
    n_actions: int,
    parameters: Values,
    seen: Seen,
) -> Array:
    """Return the log-probabilities of all responses of one participant, given the trials before.

    Args:
        model: The model.
        n_states: States of the task.
        n_actions: Responses of the task.
        parameters: Of this participant.
        seen: What was seen before each choice.

    Shapes:
        seen: ``(n_choices,)``; result: ``(n_choices, n_actions)``.
    """

    def scan(memory: Memory, now: Seen) -> tuple[Memory, Array]:
        each, memory = advance(model, n_states, n_actions, parameters, memory, now)
        return memory, each

    return jax.lax.scan(scan, begin(model, parameters, n_states, n_actions), seen)[1]


def log_likelihoods(
    model: type[CognitiveModel],
    n_states: int,
    n_actions: int,
    parameters: Values,
    seen: Seen,
    responses: Array,
) -> Array:
    """Return the log-probabilities of the choices of one participant, as `log_probabilities`.

    Shapes:
        seen, responses, result: ``(n_choices,)``.
    """
    each = log_probabilities(model, n_states, n_actions, parameters, seen)
    return jnp.take_along_axis(each, jnp.asarray(responses)[:, None], axis=1)[:, 0]


def sample(probabilities: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
    """Draw a response from each row of probabilities.

    Args:
        probabilities: Of the responses.
        rng: The generator; None: NumPy's global one.

    Shapes:
        probabilities: ``(n, n_actions)``; result: ``(n,)``.
    """
    sums = probabilities.cumsum(axis=1)
    draw = np.random.random if rng is None else rng.random
    chances = draw((len(sums), 1)) * sums[:, -1:]
    return (chances >= sums[:, :-1]).sum(axis=1)
