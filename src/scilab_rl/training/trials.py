"""Trial-level tables: what an agent saw, did, got and thought, a row per step or per episode."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from scilab_rl.algorithms.inspection import Q_VALUES, Inspection
from scilab_rl.errors import ConfigError
from scilab_rl.metrics.probes import EpisodeProbes, answerable, built_in
from scilab_rl.seeding import derive_seed

_log = logging.getLogger(__name__)
# Probe -> column.
_THOUGHTS = {
    "value": "value",
    "q_value": "q_value",
    "critic_variance": "uncertainty",
    "td_error": "surprise",
    "intrinsic_reward": "intrinsic_reward",
    "entropy": "entropy",
    "log_prob": "log_prob",
    "goal_distance": "goal_distance",
    "success": "success",
}
MOST_DIMENSIONS = 12
Row = dict[str, Any]
Choose = Callable[[Any], Any]


def collect(
    model: Any,
    env: VecEnv,
    n_episodes: int,
    seed: int,
    *,
    choose: Choose | None = None,
    most_dimensions: int = MOST_DIMENSIONS,
) -> list[Row]:
    """Let an agent act and return a row per step.

    A row holds the observation before the action, the action, the reward it brought, and what the
    agent thought of that very step: ``value`` and ``q_value`` (means over critics),
    ``uncertainty`` (variance over critics), ``surprise`` (absolute TD error), ``intrinsic_reward``,
    ``entropy``, ``log_prob``; for discrete actions also ``q_0``, ``q_1``, ... of all actions. What
    an algorithm cannot answer has no column.

    Args:
        model: The agent.
        env: A vector environment with one environment.
        n_episodes: How many episodes.
        seed: Of the episodes.
        choose: Returns the action for an observation; None means the agent's most likely one.
        most_dimensions: So many numbers of each part of an observation.
    """
    mind = Inspection(model)
    probes = [built_in(name) for name in _THOUGHTS if name in answerable(mind)]
    raw = _raw_observations(env)
    env.seed(seed)
    observation = raw(env.reset())
    rows: list[Row] = []
    for episode in range(n_episodes):
        asked = EpisodeProbes(mind, probes, _log.warning)
        step, total, done = 0, 0.0, False
        while not done:
            action = _act(model, observation, env, choose)
            after, rewards, dones, infos = env.step(np.asarray(action)[None])
            done, info, reward = bool(dones[0]), infos[0], float(rewards[0])
            following = _terminal(env, info) if done else raw(after)
            total += reward
            with mind.undisturbed():
                thoughts = asked.of_step(observation, action, reward, following, info, done)
                values = _action_values(mind, observation, env)
            rows.append(
                {"episode": episode, "step": step}
                | _columns(observation, most_dimensions)
                | _numbered("action", action)
                | {"reward": reward, "return_so_far": total}
                | {_THOUGHTS[name]: _column_value(name, x) for name, x in thoughts.items()}
                | values
                | {
                    "terminated": done and not info.get("TimeLimit.truncated", False),
                    "truncated": done and bool(info.get("TimeLimit.truncated", False)),
                }
            )
            observation, step = raw(after), step + 1
    return rows


def by_episode(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return a row per episode: its length, return and outcome, and the means of the thoughts."""
    episodes: dict[Any, list[Mapping[str, Any]]] = {}
    for row in rows:
        episodes.setdefault(row["episode"], []).append(row)
    averaged = [name for name in _THOUGHTS.values() if name != "success"]
    summary = []
    for number, steps in episodes.items():
        last = steps[-1]
        summary.append(
            {"episode": number, "steps": len(steps), "return": last["return_so_far"]}
            | {
                f"mean_{name}": float(np.mean([row[name] for row in steps if name in row]))
                for name in averaged
                if any(name in row for row in steps)
            }
            | {key: last[key] for key in ("success", "terminated", "truncated") if key in last}
        )
    return summary


def softmax_choice(model: Any, inverse_temperature: float, seed: int) -> Choose:
    """Return a simulated participant: P(a) is proportional to exp(beta Q(s, a)) (Luce, 1959).

    Args:
        model: An agent with values for discrete actions.
        inverse_temperature: beta; 0 chooses at random, large values choose the best.
        seed: Of the choices.

    Raises:
        ConfigError: If the agent has no such values.
    """
    mind, space = Inspection(model), model.action_space
    if not isinstance(space, spaces.Discrete) or Q_VALUES not in mind.quantities:
        raise ConfigError(
            f"--softmax needs an algorithm with values of discrete actions, such as cleandqn, and "
            f"not {type(model).__name__} with {space}."
        )
    # Not the very numbers that the environment draws from the same seed.
    rng = np.random.default_rng(derive_seed(seed, "choices"))

    def choose(observation: Any) -> Any:
        with mind.undisturbed():
            values = _values_of_actions(mind, observation, space)
        weights = np.exp(inverse_temperature * (values - values.max()))
        return np.int64(rng.choice(int(space.n), p=weights / weights.sum()))

    return choose


def _act(model: Any, observation: Any, env: VecEnv, choose: Choose | None) -> Any:
    if choose is not None:
        return choose(observation)
    normalization = unwrap_vec_normalize(env)
    batch = (
        {key: value[None] for key, value in observation.items()}
        if isinstance(observation, dict)
        else observation[None]
    )
    if normalization is not None:
        batch = normalization.normalize_obs(batch)
    return model.predict(batch, deterministic=True)[0][0]


def _raw_observations(env: VecEnv) -> Callable[[Any], Any]:
    """Return what gives the single observation in the environment's own units."""
    normalization = unwrap_vec_normalize(env)

    def raw(batch: Any) -> Any:
        if normalization is not None:
            batch = normalization.get_original_obs()
        if isinstance(batch, dict):
            return {key: value[0].copy() for key, value in batch.items()}
        return batch[0].copy()

    return raw


def _terminal(env: VecEnv, info: Mapping[str, Any]) -> Any:
    observation = info["terminal_observation"]
    normalization = unwrap_vec_normalize(env)
    return observation if normalization is None else normalization.unnormalize_obs(observation)


def _action_values(mind: Inspection, observation: Any, env: VecEnv) -> Row:
    space = env.action_space
    if not isinstance(space, spaces.Discrete) or Q_VALUES not in mind.quantities:
        return {}
    values = _values_of_actions(mind, observation, space)
    return {f"q_{action}": float(value) for action, value in enumerate(values)}


def _values_of_actions(mind: Inspection, observation: Any, space: spaces.Discrete) -> np.ndarray:
    actions = range(int(space.start), int(space.start) + int(space.n))
    return np.array([mind.q_values(observation, np.int64(a)).mean() for a in actions])


def _columns(observation: Any, most_dimensions: int) -> Row:
    parts = observation if isinstance(observation, dict) else {"observation": observation}
    columns: Row = {}
    for name, part in parts.items():
        flat = np.asarray(part, dtype=np.float64).ravel()
        columns |= _numbered(name, flat[:most_dimensions])
        if len(flat) > most_dimensions:
            columns[f"{name}_norm"] = float(np.linalg.norm(flat))
    return columns


def _numbered(name: str, value: Any) -> Row:
    if np.ndim(value) == 0:
        return {name: value.item() if hasattr(value, "item") else value}
    return {f"{name}_{index}": float(number) for index, number in enumerate(np.ravel(value))}


def _column_value(name: str, value: float) -> float:
    return abs(value) if name == "td_error" else value
