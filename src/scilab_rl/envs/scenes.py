"""Going back to a scene of an episode, exactly, in this or another copy of its environment.

Every environment whose chance comes from its random generator can be replayed: `RunEnv` begins the
episode again and repeats its actions. With MuJoCo, a scene is also a few arrays: the simulator's
state and what it has derived from it (an action may read places that are a substep old, so that a
forward pass is not the same), and the attributes of the environment and its wrappers, such as goal,
step count and random generators. Writing them is much faster than replaying; whether they are
enough is tested on the episode itself, and where they are not, the episode is replayed.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from scilab_rl.envs.frames import SimulatorMemory, set_simulator_memory, simulator_memory
from scilab_rl.envs.run_env import EpisodeStart, RunEnv
from scilab_rl.envs.types import Observation
from scilab_rl.envs.wrapper_memory import (
    BASE_ATTRIBUTES,
    Memory,
    describe,
    is_plain,
    memory_of,
    rebuilt,
    set_memory,
)
from scilab_rl.errors import ConfigError

_log = logging.getLogger(__name__)
_NOT_STATE = (*BASE_ATTRIBUTES, "render_mode", "metadata", "_renderer")


@dataclass(frozen=True)
class Snapshot:
    """A scene as data.

    Attributes:
        simulator: All that MuJoCo holds.
        attributes: Of each layer of the environment, by name, see `wrapper_memory.describe`.
        memory: Of the wrappers.
    """

    simulator: SimulatorMemory
    attributes: list[dict[str, object]]
    memory: Memory


def take_snapshot(env: gym.Env) -> Snapshot | None:
    """Return the present scene of an environment, or None if its simulator is not MuJoCo."""
    simulator = simulator_memory(env)
    if simulator is None:
        return None
    return Snapshot(simulator, [_plain_attributes(layer) for layer in _layers(env)], memory_of(env))


def put_snapshot(env: gym.Env, snapshot: Snapshot) -> None:
    """Put an environment into a scene of another one of the same kind, which was reset before."""
    set_memory(env, snapshot.memory)
    for layer, attributes in zip(_layers(env), snapshot.attributes, strict=True):
        own = vars(layer)
        for name, description in attributes.items():
            setattr(layer, name, rebuilt(description, own.get(name)))
    set_simulator_memory(env, snapshot.simulator)


class EpisodeScenes:
    """The scenes of one episode, to which environments of the same kind can be put back.

    The episode is replayed once, which shows that it can be.

    Args:
        env: An environment of the task; it is at the episode's end afterwards.
        start: How the episode began.
        actions: What was done. Shapes: ``(n_steps, ...)``.
        expected: What was observed in each scene, to compare with; None: nothing is compared.

    Attributes:
        observations: One per scene, ``n_steps + 1``.
        rewards: One per step.
        is_fast: Whether snapshots are used; otherwise the episode is replayed until the scene.

    Raises:
        ConfigError: If the episode cannot be repeated.
    """

    def __init__(
        self,
        env: RunEnv,
        start: EpisodeStart,
        actions: Sequence[np.ndarray],
        expected: Sequence[Observation] | None = None,
    ) -> None:
        self._start, self._actions = start, list(actions)
        self.observations: list[Observation] = [_replayed(env, start, [])]
        self.rewards: list[float] = []
        self._snapshots = [take_snapshot(env.env)]
        for action in self._actions:
            observation, reward, *_ = env.step(action)
            self.observations.append(observation)
            self.rewards.append(float(reward))
            self._snapshots.append(take_snapshot(env.env))
        self.is_fast = self._snapshots[0] is not None
        if expected is not None:
            _refuse_difference(env, self.observations, expected)

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.observations)

    def put(self, env: RunEnv, scene: int) -> Observation:
        """Put an environment, which was reset before, into a scene and return its observation."""
        actions = self._actions[:scene]
        snapshot = self._snapshots[scene] if self.is_fast else None
        if snapshot is None:
            return _replayed(env, self._start, actions)
        put_snapshot(env.env, snapshot)
        env.continue_episode(self._start, actions)
        return self.observations[scene]

    def check_snapshots(self, env: RunEnv, scenes: Sequence[int]) -> bool:
        """Go back to some scenes and repeat what followed; if anything differs, use no snapshots.

        Args:
            env: Another environment of the task.
            scenes: Numbers of the scenes.

        Returns:
            Whether snapshots are used from now on.
        """
        self.is_fast = self.is_fast and all(self._is_repeated(env, scene) for scene in scenes)
        return self.is_fast

    def _is_repeated(self, env: RunEnv, scene: int) -> bool:
        self.put(env, scene)
        for step in range(scene, len(self._actions)):
            observation, reward, *_ = env.step(self._actions[step])
            if reward != self.rewards[step] or not is_equal(
                observation, self.observations[step + 1]
            ):
                _log.info("Scenes are replayed: a snapshot of scene %d is not enough.", scene)
                return False
        return True


def change_goal(env: gym.Env, observation: Observation, goal: np.ndarray) -> Observation:
    """Give an environment another desired goal in the middle of an episode.

    Args:
        env: The environment.
        observation: That of its present scene.
        goal: Shapes: ``(*goal_shape)``.

    Returns:
        The observation with this goal.

    Raises:
        ConfigError: If there are no goals, the shape is another one, or it cannot be set.
    """
    if not isinstance(observation, dict) or "desired_goal" not in observation:
        raise ConfigError(f"{env.unwrapped} has no goals that could be another one.")
    if np.shape(goal) != observation["desired_goal"].shape:
        raise ConfigError(
            f"The goal has {observation['desired_goal'].size} numbers (here: "
            f"{observation['desired_goal'].tolist()}), but {np.size(goal)} were given."
        )
    inner: Any = env.unwrapped
    owner: Any
    for owner in (inner, getattr(inner, "task", None)):  # panda-gym's goal belongs to its task
        if isinstance(getattr(owner, "goal", None), np.ndarray):
            owner.goal = np.array(goal, owner.goal.dtype)
            return {**observation, "desired_goal": owner.goal.copy()}
    raise ConfigError(f"The goal of {env.unwrapped} cannot be changed: it has no attribute 'goal'.")


def is_equal(one: Observation, other: Observation) -> bool:
    """Return whether an observation is equal to another one in the other's type; so is NaN."""
    if isinstance(one, dict) and isinstance(other, dict):
        return all(is_equal(one[key], entry) for key, entry in other.items())
    stored = np.asarray(other)
    return np.array_equal(
        np.asarray(one).astype(stored.dtype), stored, equal_nan=stored.dtype.kind == "f"
    )


def start_as_text(start: EpisodeStart) -> str:
    """Return how an episode began as JSON, in which arrays keep their types."""
    return json.dumps(describe(dict(start)), default=_array_as_json)


def start_from_text(text: str) -> EpisodeStart:
    """Return what `start_as_text` has written."""
    start: EpisodeStart = rebuilt(json.loads(text, object_hook=_array_from_json), None)
    return start


def _array_as_json(value: Any) -> dict[str, object]:
    return {"dtype": value.dtype.str, "values": value.tolist()}


def _array_from_json(entry: dict[str, Any]) -> np.ndarray:
    return np.array(entry["values"], entry["dtype"])


def _replayed(env: RunEnv, start: EpisodeStart, actions: Sequence[np.ndarray]) -> Observation:
    observation: Any = env.replay_episode({**start, "actions": actions})
    return observation


def _refuse_difference(
    env: RunEnv, observations: Sequence[Observation], expected: Sequence[Observation]
) -> None:
    for scene, (replayed, recorded) in enumerate(zip(observations, expected, strict=True)):
        if not is_equal(replayed, recorded):
            raise ConfigError(
                f"The episode cannot be repeated: scene {scene} of {env.unwrapped} differs from "
                "the recording. Either the environment or its simulator has changed since, or its "
                "chance does not come from self.np_random (scilab-rl doctor env=NAME tells)."
            )


def _layers(env: gym.Env) -> list[gym.Env]:
    """Return an environment, those that it wraps, and those that it has as attributes."""
    layers: list[gym.Env] = []
    waiting = [env]
    while waiting:
        layer = waiting.pop()
        if all(layer is not other for other in layers):
            layers.append(layer)
            waiting += [value for value in vars(layer).values() if isinstance(value, gym.Env)]
    return layers


def _plain_attributes(layer: gym.Env) -> dict[str, object]:
    """Return the attributes made of numbers, text, arrays, containers and generators.

    An array that is a window on the simulator's memory is left out: it moves with it.
    """
    described = {
        name: describe(value)
        for name, value in vars(layer).items()
        if name not in _NOT_STATE and not (isinstance(value, np.ndarray) and _is_window(value))
    }
    return {name: value for name, value in described.items() if is_plain(value)}


def _is_window(array: np.ndarray) -> bool:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array.base is not None
