"""Choices of simulated participants: a model with parameters of its own for each of them."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from scilab_rl.envs.choices.base import COLUMNS_KEY, ChoiceTask
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError
from scilab_rl.learning.cognitive import CognitiveModel, Seen, advance, beginner, sample

Row = dict[str, Any]


def make_task(env: str, env_kwargs: Mapping[str, Any]) -> ChoiceTask:
    """Return a choice task.

    Raises:
        ConfigError: If the environment is none.
    """
    env_id, _ = resolve_env_id(env)
    task = gym.make(env_id, disable_env_checker=True, **env_kwargs).unwrapped
    if not isinstance(task, ChoiceTask):
        raise ConfigError(
            f"env={env} is not a choice task. These are: Bandit, ProbabilisticReversal, TwoStep, "
            "Horizon, HiddenGoal."
        )
    return task


def length_of(
    env: str, n_trials: int | None, env_kwargs: Mapping[str, Any]
) -> tuple[dict[str, Any], int]:
    """Return arguments of a task and blocks that make so many trials; games where it has games."""
    if n_trials is None:
        return dict(env_kwargs), 1
    task = make_task(env, env_kwargs)
    if "n_trials" in inspect.signature(type(task).__init__).parameters:
        return {**env_kwargs, "n_trials": n_trials}, 1
    return dict(env_kwargs), n_trials


def simulate(
    model: type[CognitiveModel],
    parameters: Mapping[str, np.ndarray],
    env: str,
    *,
    n_trials: int | None,
    n_blocks: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> list[Row]:
    """Let participants choose and return a row per choice, with the columns of an exported table.

    Args:
        model: The model that they all have.
        parameters: By name; one value per participant.
        env: Id of a choice task.
        n_trials: Trials of each participant, in one block; games, in a task of games; None: as many
            as the task has.
        n_blocks: Several blocks, or games, of so many trials; None: as above.
        env_kwargs: Further arguments of the task.
        seed: Of tasks and choices.

    Shapes:
        parameters: ``(n_participants,)`` each.
    """
    arguments, n_default = length_of(env, n_trials, env_kwargs or {})
    n_blocks = n_blocks or n_default
    n = len(next(iter(parameters.values())))
    tasks = [make_task(env, arguments) for _ in range(n)]
    space = tasks[0].observation_space
    if problem := model.observation_problem(space):
        raise ConfigError(f"{model.__name__.lower()} cannot act in {env}: {problem}")
    step = _compiled_step(model, space.n_states, space.n_actions)
    memory = jax.tree.map(
        lambda leaf: np.repeat(leaf[None], n, axis=0),
        beginner(model, space.n_states, space.n_actions),
    )
    rng = np.random.default_rng(seed)
    values = {name: np.asarray(value, np.float32) for name, value in parameters.items()}
    seeds = np.random.SeedSequence(seed).generate_state(n)
    now = np.stack([t.reset(seed=int(s))[0] for t, s in zip(tasks, seeds, strict=True)])
    rows: list[list[Row]] = [[] for _ in tasks]
    blocks = np.zeros(n, int)
    while (blocks < n_blocks).any():
        states, responses, feedback = space.decode(now)
        chances, memory = step(values, memory, Seen(states, responses, feedback, responses < 0))
        actions = sample(np.exp(np.asarray(chances)), rng)
        for index, task in enumerate(tasks):
            if blocks[index] >= n_blocks:
                continue
            now[index], _, over, _, info = task.step(int(actions[index]))
            rows[index].append({"block": int(blocks[index]), **info[COLUMNS_KEY]})
            if over:
                blocks[index] += 1
                now[index] = task.reset()[0]
    return [
        {"participant_id": f"p{index:03d}", "env": env, **row}
        for index, own in enumerate(rows)
        for row in own
    ]


@functools.cache
def _compiled_step(
    model: type[CognitiveModel], n_states: int, n_actions: int
) -> Callable[..., Any]:
    return jax.jit(jax.vmap(functools.partial(advance, model, n_states, n_actions)))
