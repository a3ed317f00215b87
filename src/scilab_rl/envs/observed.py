"""The one place where every step of every environment can be seen, whatever the algorithm."""

from __future__ import annotations

import logging
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from scilab_rl.envs.contract import FAILURE_KEY, BrokenContractError
from scilab_rl.envs.frames import FRAME_KEY, STATE_KEY
from scilab_rl.errors import EnvironmentError_, NumericalError, ScilabRLError
from scilab_rl.metrics.success import success_of as success_of

Observation = np.ndarray | dict[str, np.ndarray]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StepBatch:
    """One step of all environments of a vector environment.

    Attributes:
        phase: ``train`` or ``eval``.
        step: Steps so far over all environments, this one included.
        episodes: Number of the running episode per environment, from 0. Shapes: ``(n_envs,)``.
        episode_steps: Index of this step in its episode, from 0. Shapes: ``(n_envs,)``.
        observations: What the agent saw before it acted. Shapes: ``(n_envs, ...)`` per entry.
        actions: What it did. Shapes: ``(n_envs, ...)``.
        rewards: Unscaled rewards. Shapes: ``(n_envs,)``.
        dones: Whether the episode ended here. Shapes: ``(n_envs,)``.
        infos: One dictionary per environment; a finished one holds ``terminal_observation``.
        next_observations: What the agent sees next; after an episode's end this is already the
            first observation of the next episode.
        frames: The scene after this step, for environments that capture frames.
        states: The simulator's state in that scene, where there is one.
    """

    phase: str
    step: int
    episodes: np.ndarray
    episode_steps: np.ndarray
    observations: Observation
    actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    infos: Sequence[dict[str, Any]]
    next_observations: Observation
    frames: Sequence[np.ndarray | None]
    states: Sequence[np.ndarray | None]


class StepObserver(Protocol):
    """Anything that wants to see each step."""

    def on_step(self, batch: StepBatch) -> None:
        """Look at a step; must not change it."""


class ObservedVecEnv(VecEnvWrapper):
    """Passes each step to its observers and refuses observations that are not finite.

    It wraps the raw vector environment directly, below any normalisation, so that observers see
    the rewards of the task itself.

    Args:
        venv: The vector environment.
        phase: ``train`` or ``eval``.
        name: How error messages call the environment.
        seed: Seed of the run, for error messages.
        allows_nan: Whether observations and rewards may be no numbers.

    Attributes:
        observers: Called in order at each step.
        step_count: Steps so far over all environments.
        reset_frame: The first scene of environment 0's running episode, while frames are captured.
        reset_state: The simulator's state in that scene.
    """

    def __init__(
        self,
        venv: VecEnv,
        phase: str,
        name: str,
        *,
        seed: int | None = None,
        allows_nan: bool = False,
    ) -> None:
        super().__init__(venv)
        self.phase = phase
        self.name = name
        self.allows_nan = allows_nan
        self._run_seed = seed
        self.observers: list[StepObserver] = []
        self.step_count = 0
        self.episodes = np.zeros(self.num_envs, dtype=np.int64)
        self.episode_steps = np.zeros(self.num_envs, dtype=np.int64)
        self.reset_frame: np.ndarray | None = None
        self.reset_state: np.ndarray | None = None
        self._observations: Any = None
        self._actions: Any = None

    def reset(self) -> Any:
        """Reset all environments; the running episodes are dropped."""
        with self._errors_named("reset"):
            self._observations = self.venv.reset()
        self._raise_reported("reset", self.venv.reset_infos)
        self._check_finite(self._observations, "observation")
        self.episode_steps[:] = 0
        self._take_first_scene()
        return self._observations

    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step.

        Raises:
            NumericalError: If an action is not finite; a simulator would fail in its own words.
        """
        self._actions = actions
        if np.issubdtype(actions.dtype, np.floating) and not np.isfinite(actions).all():
            raise NumericalError(
                f"The agent's action is {actions.tolist()} at {self.phase} step {self.step_count}: "
                "its weights are not finite. Often the learning rate is too high."
            )
        with self._errors_named("step"):
            self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Finish the step, check it and show it to the observers."""
        with self._errors_named("step"):
            observations, rewards, dones, infos = self.venv.step_wait()
        self._raise_reported("step", infos)
        if dones.any():
            self._raise_reported("reset", self.venv.reset_infos)
        observed: Any = observations
        self._check_finite(observed, "observation")
        for index in np.flatnonzero(dones):
            self._check_finite(_batch_of_one(infos[index]["terminal_observation"]), "observation")
        self._check_finite(rewards, "reward")
        self.step_count += self.num_envs
        batch = StepBatch(
            self.phase,
            self.step_count,
            self.episodes.copy(),
            self.episode_steps.copy(),
            self._observations,
            self._actions,
            rewards,
            dones,
            infos,
            observed,
            [info.pop(FRAME_KEY, None) for info in infos],
            [info.pop(STATE_KEY, None) for info in infos],
        )
        for observer in self.observers:
            observer.on_step(batch)
        if dones[0]:
            self._take_first_scene()
        self.episodes += dones
        self.episode_steps = np.where(dones, 0, self.episode_steps + 1)
        self._observations = observed
        return observations, rewards, dones, infos

    def close(self) -> None:
        """Close all environments; what goes wrong meanwhile is told and stops nobody."""
        try:
            self.venv.close()
        except Exception as error:  # noqa: BLE001 - the run is over, and its result counts
            if not isinstance(error, (EOFError, OSError)):  # of a worker that has gone before
                _log.warning("%s", self._failure("close", type(error).__name__, str(error)))
            for process in getattr(self.venv, "processes", ()):
                process.kill()
                process.join()

    def _take_first_scene(self) -> None:
        info = self.venv.reset_infos[0]
        self.reset_frame, self.reset_state = info.pop(FRAME_KEY, None), info.pop(STATE_KEY, None)

    def state(self) -> dict[str, Any]:
        """Return counters and current observations, for a checkpoint."""
        return {
            "step_count": self.step_count,
            "episodes": self.episodes,
            "episode_steps": self.episode_steps,
            "observations": self._observations,
        }

    def continue_from(self, state: Mapping[str, Any]) -> None:
        """Take up the counters and observations of a checkpoint."""
        self.step_count = state["step_count"]
        self.episodes = np.asarray(state["episodes"])
        self.episode_steps = np.asarray(state["episode_steps"])
        self._observations = state["observations"]

    def _check_finite(self, values: Any, what: str) -> None:
        if self.allows_nan:
            return
        entries = values.items() if isinstance(values, dict) else [("", values)]
        for key, array in entries:
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
                last = None if self._actions is None else np.asarray(self._actions)[index[0]]
                raise EnvironmentError_(
                    f"{self.name}: {what}{f' {key!r}' if key else ''} is {array[index]} at index "
                    f"{index[1:]} of environment {index[0]} after step {self.step_count}; "
                    f"last action {last}."
                )

    def _raise_reported(self, call: str, infos: Sequence[dict[str, Any]]) -> None:
        """Raise what happened in another process."""
        for info in infos:
            if FAILURE_KEY in info:
                raise self._failure(call, *info[FAILURE_KEY])

    def _failure(self, call: str, kind: str, text: str) -> EnvironmentError_:
        what = "broke its contract" if kind == BrokenContractError.__name__ else f"raised {kind}"
        seed = "" if self._run_seed is None else f" (seed {self._run_seed})"
        return EnvironmentError_(
            f"{self.name} {what} in {call}() at {self.phase} step {self.step_count}{seed}: "
            f"{' '.join(text.split())}"
        )

    def _dead_worker(self) -> str:
        """Say which worker process has ended and how, if one has."""
        for index, process in enumerate(getattr(self.venv, "processes", ())):
            process.join(0.2)
            code = process.exitcode
            if code is not None:
                hint = ", maybe out of memory" if code == -signal.SIGKILL else ""
                return f"its worker process {index} ended with exit code {code}{hint}"
        return "a worker process does not answer"

    def _errors_named(self, call: str) -> _NamedErrors:
        return _NamedErrors(self, call)


class _NamedErrors:
    """Turns what an environment raises into one line that says which, where and when."""

    def __init__(self, env: ObservedVecEnv, call: str) -> None:
        self.env, self.call = env, call

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        is_pipe_broken = isinstance(error, (EOFError, ConnectionError))
        if is_pipe_broken and hasattr(self.env.venv, "processes"):
            text = self.env._dead_worker()
            raise self.env._failure(self.call, type(error).__name__, text) from error
        if isinstance(error, Exception) and not isinstance(error, ScilabRLError):
            raise self.env._failure(self.call, type(error).__name__, str(error)) from error


def _batch_of_one(observation: Any) -> Any:
    if isinstance(observation, dict):
        return {key: np.asarray(value)[None] for key, value in observation.items()}
    return np.asarray(observation)[None]
