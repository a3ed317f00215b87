"""Trial-level tables: what an agent saw, did, got and thought, a row per step or per episode."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs

from scilab_rl.canonical_spaces import conversions
from scilab_rl.envs.choices.base import COLUMNS_KEY
from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import ObservedStep
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.inspector import Q_VALUES, AgentInspector
from scilab_rl.learning.observations import single
from scilab_rl.metrics.probes import EpisodeProbes, answerable, built_in
from scilab_rl.metrics.success import episode_outcomes
from scilab_rl.seeding import derive_seed

_log = logging.getLogger(__name__)
# The probes whose values are columns, under their own names.
STEP_METRICS = (
    "value", "q_value", "critic_variance", "td_error", "intrinsic_reward", "entropy", "log_prob",
    "similarity", "steps_to_goal", "goal_distance", "success",
)  # fmt: skip
MOST_DIMENSIONS = 12
Row = dict[str, float]
Choose = Callable[[Observation], np.int64]


def collect(
    model: Algorithm,
    env: VecEnv,
    n_episodes: int,
    seed: int,
    *,
    choose: Choose | None = None,
    sampled: bool = False,
    most_dimensions: int = MOST_DIMENSIONS,
) -> list[Row]:
    """Let an agent act and return a row per step.

    A row holds the observation before the action, the action, the reward it brought, and what the
    agent thought of that very step: ``value`` and ``q_value`` (means over critics),
    ``critic_variance``, ``td_error`` (positive: better than expected), ``intrinsic_reward``,
    ``entropy``, ``log_prob``; for discrete actions also ``q_0``, ``q_1``, ... of all actions. What
    an algorithm cannot answer has no column. In a choice task, the columns of the trial follow.

    Args:
        model: The agent.
        env: A vector environment with one environment.
        n_episodes: How many episodes.
        seed: Of the episodes.
        choose: Returns the action for an observation; None means the agent's most likely one.
        sampled: Whether that is drawn from the policy instead.
        most_dimensions: So many numbers of each part of an observation.
    """
    inspector = AgentInspector(model)
    probes = [built_in(name) for name in STEP_METRICS if name in answerable(inspector)]
    if inspector.reason:
        _log.warning("Metrics of the agent are left out. %s", inspector.reason)
    task, newest = observed_layer(env), _Newest()
    task.observers.append(newest)
    env.seed(seed)
    seen, act = env.reset(), _Actor(model, env, choose, sampled)
    rows: list[Row] = []
    try:
        for episode in range(n_episodes):
            asked = EpisodeProbes(inspector, probes, _log.warning)
            step, total, done = 0, 0.0, False
            while not done:
                seen = env.step(act(seen, begins=step == 0))[0]
                taken = newest.step
                done, total = bool(taken.dones[0]), total + float(taken.rewards[0])
                row = _row(inspector, asked, taken, env, most_dimensions, total)
                rows.append({"episode": episode, "step": step} | row)
                step += 1
    finally:
        task.observers.remove(newest)
    fill_silent_outcomes([row for row in rows if row["terminated"] or row["truncated"]])
    return rows


class _Newest:
    """Keeps the newest step, in the environment's own units."""

    step: ObservedStep

    def on_step(self, step: ObservedStep) -> None:
        """Keep it."""
        self.step = step


def _row(
    inspector: AgentInspector,
    asked: EpisodeProbes,
    seen: ObservedStep,
    env: VecEnv,
    most_dimensions: int,
    total: float,
) -> Row:
    """Return what belongs to a step of the single environment."""
    observation, action = single(seen.observations, 0), seen.actions[0]
    reward, done, terminated = float(seen.rewards[0]), bool(seen.dones[0]), bool(seen.terminated[0])
    after, info = single(seen.next_observations, 0), seen.infos[0]
    with inspector.undisturbed():
        step_metrics = asked.of_step(observation, action, reward, after, info, done, terminated)
        values = _action_values(inspector, observation, env)
    return (
        observation_columns(observation, most_dimensions)
        | numbered("action", action)
        | {"reward": reward, "return_so_far": total}
        | {curve.panel: number for curve, number in step_metrics.items()}
        | values
        | {"terminated": terminated, "truncated": bool(seen.truncated[0])}
        | info.get(COLUMNS_KEY, {})
    )


def fill_silent_outcomes(episodes: Sequence[Row]) -> None:
    """Write what episodes count as that reported no success at their end, and say how many.

    Args:
        episodes: The last row of each step-wise episode, or a row per episode; changed in place.
    """
    values = [row.get("success") for row in episodes]
    reported = [None if value is None else bool(value) for value in values]
    outcomes = episode_outcomes(reported)
    if outcomes is None or None not in reported:
        return
    kind = next(type(row["success"]) for row in episodes if "success" in row)  # bool or float
    for row, outcome in zip(episodes, outcomes, strict=True):
        row.setdefault("success", kind(outcome))
    _log.warning(
        "%d of %d episodes reported no success or failure at their end; they count as not "
        "successful.",
        reported.count(None),
        len(episodes),
    )


def by_episode(rows: Sequence[Mapping[str, float]]) -> list[Row]:
    """Return a row per episode: its length, return and outcome, and the means of the metrics.

    Of the TD error, whose signs cancel out, it is the mean absolute value: ``mean_abs_td_error``.
    """
    episodes: dict[float, list[Mapping[str, float]]] = {}
    for row in rows:
        episodes.setdefault(row["episode"], []).append(row)
    averaged = [name for name in STEP_METRICS if name != "success"]
    summary = []
    for number, steps in episodes.items():
        last = steps[-1]
        summary.append(
            {"episode": number, "steps": len(steps), "return": last["return_so_far"]}
            | {
                _mean_name(name): _mean([row[name] for row in steps if name in row], name)
                for name in averaged
                if any(name in row for row in steps)
            }
            | {key: last[key] for key in ("success", "terminated", "truncated") if key in last}
        )
    return summary


def _mean_name(name: str) -> str:
    return "mean_abs_td_error" if name == "td_error" else f"mean_{name}"


def _mean(values: Sequence[float], name: str) -> float:
    return float(np.mean(np.abs(values) if name == "td_error" else values))


def softmax_choice(model: Algorithm, inverse_temperature: float, seed: int) -> Choose:
    """Return a simulated participant: P(a) is proportional to exp(beta Q(s, a)) (Luce, 1959).

    Args:
        model: An agent with values for discrete actions.
        inverse_temperature: beta; 0 chooses at random, large values choose the best.
        seed: Of the choices.

    Raises:
        ConfigError: If the agent has no such values.
    """
    inspector, space = AgentInspector(model), conversions(model.get_env())[0].env_space
    if not isinstance(space, spaces.Discrete) or Q_VALUES not in inspector.quantities:
        raise ConfigError(
            f"--softmax needs an algorithm with values of discrete actions, such as cleandqn, and "
            f"not {type(model).__name__} with {space}."
        )
    # Not the very numbers that the environment draws from the same seed.
    rng = np.random.default_rng(derive_seed(seed, "choices"))

    def choose(observation: Observation) -> np.int64:
        with inspector.undisturbed():
            values = _values_of_actions(inspector, observation, space)
        weights = np.exp(inverse_temperature * (values - values.max()))
        return np.int64(space.start + rng.choice(int(space.n), p=weights / weights.sum()))

    return choose


class _Actor:
    """Chooses actions, as the algorithm has them, and carries the memory of a recurrent policy."""

    def __init__(self, model: Algorithm, env: VecEnv, choose: Choose | None, sampled: bool) -> None:
        self._model, self._env, self._choose, self._sampled = model, env, choose, sampled
        self._memory: tuple[np.ndarray, ...] | None = None

    def __call__(self, seen: VecEnvObs, *, begins: bool) -> np.ndarray:
        """Return the action in a batch of one; ``begins``: this is an episode's first step."""
        if self._choose is not None:
            chosen = self._choose(single(observed_layer(self._env).observations, 0))
            return conversions(self._env)[0].from_env(np.asarray(chosen)[None])
        action, self._memory = self._model.predict(
            seen,
            state=self._memory,
            episode_start=np.array([begins]),
            deterministic=not self._sampled,
        )
        return action


def _action_values(inspector: AgentInspector, observation: Observation, env: VecEnv) -> Row:
    space = conversions(env)[0].env_space
    if not isinstance(space, spaces.Discrete) or Q_VALUES not in inspector.quantities:
        return {}
    values = _values_of_actions(inspector, observation, space)
    return {f"q_{space.start + index}": float(value) for index, value in enumerate(values)}


def _values_of_actions(
    inspector: AgentInspector, observation: Observation, space: spaces.Discrete
) -> np.ndarray:
    actions = range(int(space.start), int(space.start) + int(space.n))
    return np.array([inspector.q_values(observation, np.int64(a)).mean() for a in actions])


def observation_columns(observation: Observation, most_dimensions: int = MOST_DIMENSIONS) -> Row:
    """Return an observation as columns: ``observation_0`` and so on, and of goals likewise."""
    parts = observation if isinstance(observation, dict) else {"observation": observation}
    columns: Row = {}
    for name, part in parts.items():
        flat = np.asarray(part, dtype=np.float64).ravel()
        columns |= numbered(name, flat[:most_dimensions])
        if len(flat) > most_dimensions:
            columns[f"{name}_norm"] = float(np.linalg.norm(flat))
    return columns


def numbered(name: str, value: np.ndarray) -> Row:
    """Return a number as one column, and an array as one for each of its numbers."""
    if np.ndim(value) == 0:
        return {name: value.item()}
    return {f"{name}_{index}": float(number) for index, number in enumerate(np.ravel(value))}
