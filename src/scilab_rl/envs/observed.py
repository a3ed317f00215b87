"""The one place where every step of every environment can be seen, whatever the algorithm."""

from __future__ import annotations

import logging
import signal
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from scilab_rl.envs.contract import BrokenContractError
from scilab_rl.envs.frames import FRAME_KEY, STATE_KEY
from scilab_rl.envs.run_env import FAILURE_KEY, START_KEY, EpisodeStart
from scilab_rl.envs.stability import STATES_KEY
from scilab_rl.envs.types import Info, Observation
from scilab_rl.envs.vec_step import ObservedStep, VecStep, decode_step
from scilab_rl.errors import EnvironmentFailure, NumericalError, ScilabRLError

_log = logging.getLogger(__name__)


class StepObserver(Protocol):
    """An observer of each step."""

    def on_step(self, step: ObservedStep) -> None:
        """Look at a step; must not change it."""


class ObservedVecEnv(VecEnvWrapper):
    """Passes each step to its observers and refuses observations that are not finite.

    It wraps the raw vector environment directly, below any normalization, so that observers see
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
        episode_start: How that episode began, to repeat it.
        task_rewards: Of the last step, before any normalization. Shapes: ``(n_envs,)``.
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
        self.reset_frame: np.ndarray | str | None = None
        self.reset_state: np.ndarray | None = None
        self.episode_start: EpisodeStart | None = None
        self.task_rewards = np.zeros(self.num_envs, dtype=np.float32)
        self._observations: Any = None
        self._actions: np.ndarray | None = None

    def reset(self) -> VecEnvObs:
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
        self._actions = np.array(actions)  # the caller may keep using its own
        if np.issubdtype(actions.dtype, np.floating) and not np.isfinite(actions).all():
            raise NumericalError(
                f"The agent's action is {actions.tolist()} at {self.phase} step {self.step_count}: "
                "its weights are not finite. Often the learning rate is too high."
            )
        with self._errors_named("step"):
            self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step, check it and show it to the observers."""
        with self._errors_named("step"):
            observations: Any
            observations, rewards, dones, infos = self.venv.step_wait()
        self._raise_reported("step", infos)
        if dones.any():
            self._raise_reported("reset", self.venv.reset_infos)
        assert self._actions is not None  # of `step_async`
        # Layers above put their own last observation into the infos.
        own_infos = [dict(info) for info in infos]
        decoded = decode_step(
            self._observations, self._actions, observations, rewards, dones, own_infos
        )
        self._check_step(decoded)
        self.step_count += self.num_envs
        self.task_rewards = rewards.copy()
        self._show(decoded)
        for info in infos:
            for key in (FRAME_KEY, STATE_KEY, STATES_KEY):  # for observers only
                info.pop(key, None)
        if dones[0]:
            self._take_first_scene()
        self.episodes += dones
        self.episode_steps = np.where(dones, 0, self.episode_steps + 1)
        self._observations = observations
        return observations, rewards, dones, infos

    def _check_step(self, step: VecStep) -> None:
        self._check_finite(step.reset_observations, "observation")
        if step.next_observations is not step.reset_observations:
            self._check_finite(step.next_observations, "observation")
        self._check_finite(step.rewards, "reward")

    def _show(self, decoded: VecStep) -> None:
        step = ObservedStep(
            **vars(decoded),
            phase=self.phase,
            step=self.step_count,
            episodes=self.episodes.copy(),
            episode_steps=self.episode_steps.copy(),
            frames=[info.pop(FRAME_KEY, None) for info in decoded.infos],
            states=[info.pop(STATE_KEY, None) for info in decoded.infos],
        )
        for observer in self.observers:
            observer.on_step(step)

    @property
    def observations(self) -> Observation:
        """The environments' own newest observations. Shapes: ``(n_envs, ...)`` per entry."""
        return self._observations

    def close(self) -> None:
        """Close all environments; errors are logged and do not stop the others."""
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
        self.episode_start = info.pop(START_KEY, None)

    def state(self) -> dict[str, object]:
        """Return counters and current observations, for a checkpoint."""
        return {
            "step_count": self.step_count,
            "episodes": self.episodes,
            "episode_steps": self.episode_steps,
            "observations": self._observations,
        }

    def continue_from(self, state: Info) -> None:
        """Take up the counters and observations of a checkpoint."""
        self.step_count = state["step_count"]
        self.episodes = np.asarray(state["episodes"])
        self.episode_steps = np.asarray(state["episode_steps"])
        self._observations = state["observations"]

    def _check_finite(self, values: Observation, what: str) -> None:
        if self.allows_nan:
            return
        entries = values.items() if isinstance(values, dict) else [("", values)]
        for key, array in entries:
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
                last = None if self._actions is None else np.asarray(self._actions)[index[0]]
                raise EnvironmentFailure(
                    f"{self.name}: {what}{f' {key!r}' if key else ''} is {array[index]} at index "
                    f"{index[1:]} of environment {index[0]} after step {self.step_count}; "
                    f"last action {last}."
                )

    def _raise_reported(self, call: str, infos: Sequence[Info]) -> None:
        """Raise what happened in another process."""
        for info in infos:
            if FAILURE_KEY in info:
                raise self._failure(call, *info[FAILURE_KEY])

    def _failure(self, call: str, kind: str, text: str) -> EnvironmentFailure:
        what = "broke its contract" if kind == BrokenContractError.__name__ else f"raised {kind}"
        seed = "" if self._run_seed is None else f" (seed {self._run_seed})"
        return EnvironmentFailure(
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

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        is_pipe_broken = isinstance(error, (EOFError, ConnectionError))
        if is_pipe_broken and hasattr(self.env.venv, "processes"):
            text = self.env._dead_worker()
            raise self.env._failure(self.call, type(error).__name__, text) from error
        if isinstance(error, Exception) and not isinstance(error, ScilabRLError):
            raise self.env._failure(self.call, type(error).__name__, str(error)) from error
