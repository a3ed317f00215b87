"""Does steps of CleanRL's SAC, as the benchmarks ask; see `recorded`.

CleanRL is a script, `cleanrl/sac_continuous_action.py`, and runs here as it was published. In place
of the old Gym it gets an environment in whose `step` it waits for requests: FetchReach with its
goal in the observation, or one that repeats recorded steps and then costs nothing. So a request
takes the script once around its loop: an update, the choice of one action, and one transition
stored. It has no hindsight and no other layers than [256, 256]; its actor learns every second time,
twice.

Runs in the peers' virtual environment: cleanrl_sac.py STEPS|live BATCH_SIZE
"""

import os
import runpy
import sys
import tempfile
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
from gymnasium import spaces
from recorded import Requests, Step, given, read_steps

N_RANDOM = 100  # steps before the first update of a run that takes its own


class RecordedActions(spaces.Box):
    """An action space whose samples are those of the recorded steps."""

    def __init__(self, actions: list[np.ndarray]) -> None:
        super().__init__(-1.0, 1.0, actions[0].shape, np.float32)
        self._actions = iter(actions)

    def sample(self) -> np.ndarray:
        """Return the next one."""
        return next(self._actions)


class WaitingEnv:
    """Gym's vector environment with the recorded steps, each of which ends in the wait for work."""

    num_envs = 1

    def __init__(self, steps: list[Step], requests: Requests) -> None:
        self.single_observation_space = spaces.Box(-np.inf, np.inf, flat(steps[0].now).shape)
        self.single_action_space = RecordedActions([step.action for step in steps])
        self.action_space = spaces.Box(-1.0, 1.0, (1, *steps[0].action.shape), np.float32)
        self._outcomes = self._play(steps, requests)

    def reset(self) -> np.ndarray:
        """Return the first observation."""
        return next(self._outcomes)

    def step(self, _actions: np.ndarray) -> tuple[Any, ...]:
        """Return what comes next, whatever the action."""
        return next(self._outcomes)

    def _play(self, steps: list[Step], requests: Requests) -> Iterator[Any]:
        begins = [flat(step.now)[None] for step in [*steps[1:], steps[0]]]
        yield flat(steps[0].now)[None]
        for step, after in zip(steps, begins, strict=True):
            info = {"TimeLimit.truncated": step.over, "terminal_observation": flat(step.following)}
            yield after, np.array([step.reward]), np.array([step.over]), [info]
        still = begins[-1], np.array([-1.0]), np.array([False]), [{}]
        yield still  # the script learns from the step after `learning-starts`
        while n_steps := requests.next():
            for _ in range(n_steps):
                yield still
        sys.exit()


class LiveEnv:
    """Gym's vector environment with FetchReach, which waits when it has stepped often enough."""

    num_envs = 1

    def __init__(self, env: gymnasium.Env, requests: Requests) -> None:
        self._env, self._requests = env, requests
        self._n_left = N_RANDOM
        self.single_observation_space = spaces.Box(-np.inf, np.inf, self.reset().shape[1:])
        self.single_action_space = env.action_space
        self.action_space = spaces.Box(-1.0, 1.0, (1, *env.action_space.shape), np.float32)

    def reset(self) -> np.ndarray:
        """Begin an episode."""
        return flat(self._env.reset()[0])[None]

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """Take a step, and begin the next episode where one ends."""
        while not self._n_left:
            self._n_left = self._requests.next() or sys.exit()
        self._n_left -= 1
        observation, reward, _, over, _ = self._env.step(actions[0])
        info = {"TimeLimit.truncated": over, "terminal_observation": flat(observation)}
        after = self.reset() if over else flat(observation)[None]
        return after, np.array([reward]), np.array([over]), [info]


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Return the entries of an observation as one vector."""
    return np.concatenate(list(observation.values())).astype(np.float32)


def main() -> None:
    """Run the script with these steps."""
    requests = Requests()
    path, batch_size, _ = given()
    if path is None:
        gymnasium.register_envs(gymnasium_robotics)
        env: Any = LiveEnv(gymnasium.make("FetchReach-v4"), requests)
        n_random = N_RANDOM
    else:
        steps = list(read_steps(path))
        env, n_random = WaitingEnv(steps, requests), len(steps)
    gym: Any = ModuleType("gym")
    gym.spaces = spaces
    gym.vector = SimpleNamespace(SyncVectorEnv=lambda _makers: env)
    sys.modules["gym"] = gym
    sys.argv = [
        "sac_continuous_action.py", "--learning-starts", str(n_random),
        "--batch-size", str(batch_size), "--cuda", "False",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:  # it writes files for TensorBoard
        os.chdir(folder)
        runpy.run_module("cleanrl.sac_continuous_action", run_name="__main__")


if __name__ == "__main__":
    main()
