"""Whoever chooses the actions in a single environment: a script, chance, or a saved policy."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.scripted import Controller, controller_for
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import CONFIG_FILE, find_policy, find_run

if TYPE_CHECKING:  # heavy
    import gymnasium as gym
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.envs.types import Info, Observation
    from scilab_rl.learning.algorithm import Algorithm

SCRIPTED, RANDOM = "scripted", "random"


@dataclass(frozen=True)
class Step:
    """One step of an episode, in the environment's own units."""

    observation: Observation
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    info: Info
    next_observation: Observation


class RandomActions(Controller):
    """Draws a share of the actions uniformly, and lets another controller choose the others.

    Args:
        env: Whose actions they are.
        seed: Of what is drawn.
        share: Of random actions.
        other: Chooses the others; None: all actions are random.
    """

    def __init__(
        self, env: gym.Env, seed: int, share: float = 1.0, other: Controller | None = None
    ) -> None:
        self._space, self._share, self._other = env.action_space, share, other
        self._space.seed(seed)
        self._random = np.random.default_rng(seed)

    def begin(self) -> None:
        """Begin an episode."""
        if self._other is not None:
            self._other.begin()

    def act(self, observation: Any) -> Any:
        """Return the action."""
        # The other one is always asked: it may remember what it has seen.
        chosen = None if self._other is None else self._other.act(observation)
        is_random = chosen is None or self._random.random() < self._share
        return self._space.sample() if is_random else chosen


class SavedPolicy(Controller):
    """Takes the most likely actions of a policy.

    Args:
        env: The vector environment in which it sees and acts.
        model: The algorithm with the policy.
    """

    def __init__(self, env: VecEnv, model: Algorithm) -> None:
        from scilab_rl.canonical_spaces import conversions
        from scilab_rl.learning.inspector import observation_functions

        self._model, self._memory = model, None
        self._functions = observation_functions(env)
        self._to_env = conversions(env)[0].to_env

    def begin(self) -> None:
        """Begin an episode."""
        self._memory = None

    def act(self, observation: Any) -> Any:
        """Return the action."""
        from scilab_rl.learning.observations import batch_of_one

        batch = batch_of_one(observation)
        for function in self._functions:
            batch = function(batch)
        actions, self._memory = self._model.predict(batch, self._memory, deterministic=True)  # type: ignore[assignment]
        return self._to_env(actions)[0]


@contextlib.contextmanager
def controlled_env(
    name: str, cfg: RunConfig, seed: int, *, key: str
) -> Iterator[tuple[gym.Env, Controller]]:
    """Make the environment of a configuration, and who acts in it; close it afterwards.

    Args:
        name: ``scripted``, ``random``, or a run or ``agent:NAME``, whose environment it then is.
        cfg: Names the environment.
        seed: Of random actions.
        key: What names the controller, for messages.

    Raises:
        ConfigError: If there is no such controller, or it is one of another environment.
    """
    from scilab_rl.envs.vectorize import make_single_env

    with contextlib.ExitStack() as closing:
        if name in (SCRIPTED, RANDOM):
            env = make_single_env(cfg)
            closing.callback(env.close)
            yield env, controller_for(env) if name == SCRIPTED else RandomActions(env, seed)
            return
        theirs, their_env, model = _load(name, cfg, key)
        closing.callback(their_env.close)
        env = make_single_env(theirs)
        closing.callback(env.close)
        yield env, SavedPolicy(their_env, model)


def play_episode(env: gym.Env, controller: Controller, seed: int | None) -> list[Step]:
    """Play an episode; with a seed, the first of a new sequence of them."""
    controller.begin()
    observation, _ = env.reset(seed=seed)
    steps: list[Step] = []
    while not steps or not (steps[-1].terminated or steps[-1].truncated):
        action = np.asarray(controller.act(observation), env.action_space.dtype)
        after, reward, terminated, truncated, info = env.step(action)
        steps.append(Step(observation, action, float(reward), terminated, truncated, info, after))
        observation = after
    return steps


def _load(name: str, cfg: RunConfig, key: str) -> tuple[RunConfig, VecEnv, Algorithm]:
    from scilab_rl.config.recorded import load_recorded
    from scilab_rl.run.player import load_player

    run = find_run(name, Path(cfg.base_logdir))
    theirs = load_recorded(run / CONFIG_FILE)
    if (theirs.env, dict(theirs.env_kwargs)) != (cfg.env, dict(cfg.env_kwargs)):
        raise ConfigError(
            f"{key}: {run} was trained in {theirs.env}, which is not {cfg.env} with these "
            "env_kwargs; name a run of the same environment."
        )
    saved = find_policy(run, name, "best", "finished")
    return theirs, *load_player(theirs, saved, record=False)
