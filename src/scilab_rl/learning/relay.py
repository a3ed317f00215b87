"""Relay hindsight: one network learns to bring the effector to the object, and the task.

Luo et al., 2022, "Relay Hindsight Experience Replay", arXiv 2208.00843. An arm that never touches
an object learns nothing about moving it: every achieved goal of the episode is the same. So the
same network learns a goal that comes first: bring the effector (the gripper) to where the object
is. A flag at the end of the observation's vector tells the two goals apart, and either takes the
place of the desired goal.

* Half of each batch is of the task (flag 0), half of the first goal (flag 1): its desired goal is
  the object's place, and in the relabeled part a place that the effector reaches later in the same
  episode. Its reward is 0 within ``threshold`` of that, and -1 elsewhere.
* While exploring, an effector that is far from the object follows the first goal now and then.

What differs from the paper: the two goals share one place in the vector, distinguished by the flag,
instead of having masked places of their own. Where the task's goal is longer (the places of several
blocks), the first goal takes its first numbers, and the others are 0. The task's reward is not
changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.learning.compatibility import is_goal_space

_PLACES = ("effector", "object")
_NUMBERS = ("threshold", "far", "follow")
_KEYS = (*_PLACES, *_NUMBERS)


class Relay:
    """The two goals of a task with an effector and an object.

    Args:
        space: Observations with goals.
        effector: Where the effector's place begins and ends in the entry ``observation``.
        object: The same for the object's place, in the same units.
        threshold: Distance up to which the effector counts as being at the object.
        far: Distance from which on an exploring effector may follow the first goal.
        follow: Share of such steps in which it does.

    Shapes:
        vectors: ``(batch, n)`` without the flag, ``(batch, n + 1)`` with it.

    Raises:
        ConfigError: If the places do not fit the observations.
    """

    def __init__(
        self,
        space: spaces.Space,
        effector: Sequence[int],
        object: Sequence[int],
        threshold: float = 0.05,
        far: float = 0.03,
        follow: float = 0.5,
    ) -> None:
        if not is_goal_space(space):
            raise ConfigError(
                "algorithm.relay needs an environment with goals; set algorithm.relay=null."
            )
        assert isinstance(space, spaces.Dict)
        starts = dict(
            zip(space.spaces, np.cumsum([0, *map(spaces.flatdim, space.values())]), strict=False)
        )
        begin, length = int(starts["observation"]), spaces.flatdim(space["observation"])
        self.effector = _columns("effector", effector, begin, length)
        self.object = _columns("object", object, begin, length)
        first, size = int(starts["desired_goal"]), spaces.flatdim(space["desired_goal"])
        n_coordinates = self.object.stop - self.object.start
        self.desired_goal = slice(first, first + size)
        self.first_goal = slice(first, first + n_coordinates)
        if not self.effector.stop - self.effector.start == n_coordinates <= size:
            raise ConfigError(
                f"algorithm.relay.effector {list(effector)} and object {list(object)} must be "
                f"equally long and at most {size} long as the desired goal; name fewer coordinates."
            )
        self.threshold, self.far, self.follow = threshold, far, follow

    def with_flag(self, vectors: np.ndarray, flag: float | np.ndarray = 0.0) -> np.ndarray:
        """Append the flag: 0 for the task's goal, 1 for the first goal."""
        flags = np.broadcast_to(np.asarray(flag, np.float32), len(vectors))
        return np.concatenate([vectors, flags[:, None]], axis=1, dtype=np.float32)

    def choose_goals(self, vectors: np.ndarray) -> np.ndarray:
        """Let some of the effectors that are far from the object follow the first goal.

        Args:
            vectors: Observations while exploring, without the flag.

        Returns:
            The observations with flag, and in the chosen ones with the object's place as goal.
        """
        distance = np.linalg.norm(vectors[:, self.effector] - vectors[:, self.object], axis=1)
        chosen = (distance > self.far) & (np.random.random(len(vectors)) < self.follow)
        chosen_vectors = self.with_flag(vectors, chosen)
        self.set_goals(chosen_vectors, chosen, vectors[chosen, self.object])
        return chosen_vectors

    def set_goals(self, vectors: np.ndarray, chosen: np.ndarray, goals: np.ndarray) -> None:
        """Put first goals in the place of the desired goals of some vectors.

        Args:
            vectors: With or without the flag, changed in place.
            chosen: Which of them, as indices or as a mask.
            goals: Shapes: ``(n_chosen, n_coordinates)``.
        """
        vectors[chosen, self.desired_goal] = 0.0
        vectors[chosen, self.first_goal] = goals

    def rewards(self, next_vectors: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return 0 where the effector is at its goal, -1 elsewhere. Shapes: ``(batch,)``."""
        distance = np.linalg.norm(next_vectors[:, self.effector] - goals, axis=1)
        return -(distance > self.threshold).astype(np.float32)


def make_relay(settings: Mapping[str, Any] | None, space: spaces.Space) -> Relay | None:
    """Return the relay that ``algorithm.relay`` describes; None: none.

    Raises:
        ConfigError: If a key is unknown or missing, or does not fit the observations.
    """
    if settings is None:
        return None
    if not isinstance(settings, Mapping):
        raise ConfigError(
            "algorithm.relay must be null or a mapping, for example "
            f"{{effector: [0, 3], object: [3, 6]}}, but it is {settings!r}."
        )
    for key in settings:
        if key not in _KEYS:
            raise ConfigError(
                f"There is no algorithm.relay.{key}.{did_you_mean(str(key), _KEYS)} There are "
                f"{', '.join(_KEYS)}."
            )
    if missing := [key for key in _PLACES if key not in settings]:
        raise ConfigError(
            f"algorithm.relay needs {' and '.join(missing)}: where in the entry observation the "
            "place is, for example {effector: [0, 3], object: [3, 6]}."
        )
    for key in _NUMBERS:
        value = settings.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigError(f"algorithm.relay.{key} must be a number, but it is {value!r}.")
    return Relay(space, **settings)


def _columns(name: str, given: Sequence[int], begin: int, length: int) -> slice:
    ends = [end for end in given if isinstance(end, int)] if isinstance(given, Sequence) else []
    if len(ends) != 2 or not 0 <= ends[0] < ends[1] <= length:
        raise ConfigError(
            f"algorithm.relay.{name} must be [from, to] within the {length} numbers of the entry "
            f"observation, but it is {given!r}."
        )
    return slice(begin + ends[0], begin + ends[1])
