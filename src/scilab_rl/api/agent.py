"""Trained agents in Python: they act, say what they think, and are measured and recorded."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from scilab_rl.analysis.estimates import Estimate, aggregate, success_interval
from scilab_rl.api.isolation import isolated
from scilab_rl.api.shown import Replay
from scilab_rl.api.tables import as_table
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.errors import ConfigError, RenderingError
from scilab_rl.metrics.probes import ARGUMENTS, Probe, answerable, resolve_metrics
from scilab_rl.run.checks import prepare_torch
from scilab_rl.run.directory import (
    CONFIG_FILE,
    RunDirectory,
    find_policy,
    find_run,
    reports_success,
)
from scilab_rl.run.player import load_player
from scilab_rl.seeding import seed_everything

if TYPE_CHECKING:  # heavy
    import gymnasium
    import pandas
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.canonical_spaces import Conversion
    from scilab_rl.envs.types import Observation
    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.learning.inspector import AgentInspector
    from scilab_rl.training.evaluation import Episode, Evaluation

_SAVED = ("best", "finished")


def load(
    run: str | Path = "last",
    *,
    policy: str = "best",
    base_logdir: str | Path = "data",
) -> Agent:
    """Load a trained agent.

    Args:
        run: ``last``, ``agent:NAME`` for a trained agent of the package or the project, the path of
            a run or of a saved policy inside of one, or a part of a run's name.
        policy: ``best`` or ``finished``, the policy at the end; where there is only one, that. Or
            the name or path of another one.
        base_logdir: The folder of all runs.

    Raises:
        ConfigError: If there is no such run, agent or policy.
        CheckpointError: If the policy is damaged.
        MissingDependencyError: If its algorithm or environment needs a package that is missing.
    """
    agent = find(run, policy, base_logdir)
    agent.algorithm  # noqa: B018 - so that what is wrong with it is said here
    return agent


def find(run: str | Path, policy: str = "best", base_logdir: str | Path = "data") -> Agent:
    """Find a trained agent as `load` does; it is loaded when it is used.

    Raises:
        ConfigError: If there is no such run, agent or policy.
    """
    open_project()
    found = find_run(str(run), Path(base_logdir))
    names = (str(run), policy, *_SAVED) if policy in _SAVED else (policy,)
    return Agent(found, load_recorded(found / CONFIG_FILE), find_policy(found, *names))


@dataclass(frozen=True)
class EvaluationSummary:
    """How good an agent was in some episodes.

    Attributes:
        n_episodes: How many.
        success: Share of the episodes that ended in success, with Wilson's 95 % interval; None for
            a task without success.
        mean_return: Mean sum of rewards, with a 95 % bootstrap interval.
        returns: Sum of rewards of each episode. Shapes: ``(n_episodes,)``.
        lengths: Steps of each episode. Shapes: ``(n_episodes,)``.
        metrics: All metrics of the evaluation, by the names that trackers use.
        replay: The recording of the first episode, if it was asked for.
    """

    n_episodes: int
    success: Estimate | None
    mean_return: Estimate
    returns: np.ndarray = field(repr=False)
    lengths: np.ndarray = field(repr=False)
    metrics: Mapping[str, float] = field(repr=False)
    replay: Replay | None = None

    def __str__(self) -> str:
        success = "" if self.success is None else f"success {self.success}, "
        return f"{success}return {self.mean_return} ({self.n_episodes} episodes)"


class Agent:
    """A trained policy with the environment that it was trained for.

    Observations and actions are those of the environment, as `make_env` returns and takes them:
    whatever normalization and scaling the algorithm has learned with is done here.

    Args:
        run: The run that it is from.
        cfg: The run's configuration.
        policy: The saved policy.

    Attributes:
        run: The run that it is from.
        cfg: The run's configuration.
        policy: The folder of the saved policy.
    """

    def __init__(self, run: RunDirectory, cfg: RunConfig, policy: Path) -> None:
        self.run = run
        self.cfg = cfg
        self.policy = policy
        self._memory: tuple[np.ndarray, ...] | None = None  # of a recurrent policy
        self._n_remembered = 0

    def __repr__(self) -> str:
        return f"<Agent {self.run}: {self.cfg.algorithm.name} in {self.cfg.env}>"

    def __enter__(self) -> Agent:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm with its networks; its spaces are canonical and may be normalized."""
        return self._player[1]

    @property
    def env(self) -> VecEnv:
        """The environment for evaluation, as the algorithm sees it."""
        return self._player[0]

    @property
    def observation_space(self) -> gymnasium.Space:
        """The environment's own space of observations."""
        return self._conversions[1].env_space

    @property
    def action_space(self) -> gymnasium.Space:
        """The environment's own space of actions."""
        return self._conversions[0].env_space

    @property
    def unseen_seed(self) -> int:
        """The run's seed plus 1: that of episodes in which it has never been."""
        return int(self.cfg.seed) + 1

    @property
    def probes(self) -> tuple[str, ...]:
        """The names of what it can be asked with `probe`."""
        return tuple(answerable(self.inspector))

    def predict(
        self, observation: Observation, *, deterministic: bool = True, begins: bool = False
    ) -> np.ndarray:
        """Return the action for an observation, or one for each of a batch.

        Args:
            observation: One of `observation_space`, or a batch of them.
            deterministic: Whether the most likely action is taken, rather than a sample.
            begins: Whether these are the first observations of episodes: a recurrent policy, which
                remembers those of the calls before, then forgets them. Others remember nothing.

        Shapes:
            observation: those of the space, or ``(batch, ...)`` per entry; result: that of
            `action_space`, or ``(batch, ...)``.

        Raises:
            ConfigError: If the observation does not have the shape of the space, or the policy
                needs to remember the ones before it.
        """
        if self.inspector.has_memory:
            raise ConfigError(
                f"The policy of {self.cfg.algorithm.name} remembers its episode, so that one "
                "observation does not tell its action; use evaluate or trajectories."
            )
        batch, is_single = self._as_batch(observation)
        seen = self.inspector.normalized(batch)
        n = len(next(iter(batch.values())) if isinstance(batch, dict) else batch)
        if n != self._n_remembered:
            self._memory, self._n_remembered = None, n
        actions, self._memory = self.algorithm.predict(
            seen,
            state=self._memory,
            episode_start=np.full(n, begins),
            deterministic=deterministic,
        )
        actions = self._conversions[0].to_env(actions)
        return actions[0] if is_single else actions

    def q_values(self, observation: Observation, action: npt.ArrayLike) -> np.ndarray:
        """Return what each critic says about an action, or about each of a batch.

        Shapes:
            observation, action: those of the spaces, or ``(batch, ...)``; result:
            ``(n_critics,)`` or ``(batch, n_critics)``.

        Raises:
            ConfigError: If the algorithm has no action values.
        """
        self._require("q_values")
        batch, is_single = self._as_batch(observation)
        actions = np.asarray(action)[None] if is_single else np.asarray(action)
        with self.inspector.undisturbed():
            values = self.inspector.q_values_of_batch(batch, actions)
        return values[0] if is_single else values

    def probe(
        self,
        name: str,
        observation: Observation,
        action: npt.ArrayLike | None = None,
        reward: float | None = None,
        next_observation: Observation | None = None,
        *,
        info: Mapping[str, object] | None = None,
        terminated: bool = False,
    ) -> Any:
        """Ask the agent about a single step.

        Args:
            name: One of `probes`, or a function of yours as ``module.function``.
            observation: What the agent saw.
            action: What it did; None means what it would do.
            reward: What that gave; needed by ``td_error``, for example.
            next_observation: What it led to; the same.
            info: What the environment said about the step.
            terminated: Whether the step led to a terminal state.

        Returns:
            A number, or several by name, or None where there is nothing to say.

        Raises:
            ConfigError: If there is no such probe, the agent cannot answer it, or it needs more of
                the step.
        """
        found = self._require(name)
        action = self.predict(observation) if action is None else np.asarray(action)
        rest = (reward, next_observation, info or {}, terminated, terminated)
        step = (observation, action, *rest)[: found.n_arguments - 1]
        missing = [n for n, v in zip(ARGUMENTS[1:], step, strict=False) if v is None]
        if missing:
            raise ConfigError(f"The probe '{name}' needs {' and '.join(missing)} of the step too.")
        with self.inspector.undisturbed():
            return found.make()(self.inspector, *step)

    def make_env(self, render_mode: str | None = None) -> gymnasium.Env:
        """Make the environment that the agent was trained for, with its wrappers.

        Args:
            render_mode: ``rgb_array`` or ``human`` to see it.
        """
        from scilab_rl.envs.vectorize import for_evaluation, make_single_env
        from scilab_rl.recording.gl import choose_backend

        if render_mode == "rgb_array":
            with contextlib.suppress(RenderingError):  # it may be no simulator that needs OpenGL
                choose_backend()
        env = make_single_env(for_evaluation(self.cfg), render_mode)
        env.get_wrapper_attr("set_wrapper_memory")(
            self.env.env_method("wrapper_memory", indices=0)[0]
        )
        return env

    @isolated()
    def evaluate(
        self,
        episodes: int = 100,
        *,
        seed: int | None = None,
        deterministic: bool = True,
        record: bool = False,
        metrics: Sequence[str] | None = None,
        on_episode: Callable[[Episode], None] | None = None,
    ) -> EvaluationSummary:
        """Let the agent act for some episodes and measure how good it is.

        Args:
            episodes: How many.
            seed: Of the episodes; None means `unseen_seed`.
            deterministic: Whether the most likely action is taken, rather than a sample.
            record: Whether the first episode is recorded.
            metrics: The curves of the recording; None means the most informative ones.
            on_episode: Called after each episode.
        """
        from scilab_rl.training.evaluation import evaluate

        seed = self.unseen_seed if seed is None else seed
        env, algorithm = load_player(self.cfg, self.policy, record=True) if record else self._player
        finish = self._film(env, algorithm, metrics, seed) if record else None
        prepare_torch(self.cfg)
        seed_everything(seed)
        try:
            evaluation = evaluate(
                algorithm,
                env,
                episodes,
                seed,
                deterministic=deterministic,
                on_episode=on_episode,
            )
        finally:
            replay = finish() if finish is not None else None
            if record:
                env.close()
        return _summary(evaluation, replay, reports_success=reports_success(self.run))

    def record(self, metrics: Sequence[str] | None = None, *, seed: int | None = None) -> Replay:
        """Record an episode: a page with scene and curves, which a notebook shows, and a video.

        Args:
            metrics: Names of probes to draw; None means the most informative ones.
            seed: Of the episode; None means `unseen_seed`.
        """
        replay = self.evaluate(1, seed=seed, record=True, metrics=metrics).replay
        assert replay is not None
        return replay

    @isolated()
    def trajectories(
        self,
        episodes: int = 20,
        *,
        per: Literal["step", "episode"] = "step",
        seed: int | None = None,
        softmax: float | None = None,
        sample: bool = False,
        dimensions: int = 12,
    ) -> list[dict[str, float]]:
        """Let the agent act and return what it saw, did, got and thought.

        Args:
            episodes: How many.
            per: What a row is: a step or an episode.
            seed: Of the episodes; None means `unseen_seed`.
            softmax: Choose with probability proportional to exp(softmax Q), as a simulated
                participant; None means the most likely action.
            sample: Whether actions are drawn from the policy. Those of cognitive models always are.
            dimensions: So many numbers of each part of an observation.

        Returns:
            The rows; `scilab_rl.training.trajectory_table.collect` explains their columns.
        """
        from scilab_rl.training.trajectory_table import by_episode, collect, softmax_choice

        seed = self.unseen_seed if seed is None else seed
        prepare_torch(self.cfg)
        choose = None if softmax is None else softmax_choice(self.algorithm, softmax, seed)
        seed_everything(seed)
        rows = collect(
            self.algorithm,
            self.env,
            episodes,
            seed,
            choose=choose,
            sampled=sample or getattr(self.algorithm, "chooses_by_chance", False),
            most_dimensions=dimensions,
        )
        return by_episode(rows) if per == "episode" else rows

    def steps(
        self,
        episodes: int = 20,
        *,
        seed: int | None = None,
        per: Literal["step", "episode"] = "step",
    ) -> pandas.DataFrame:
        """Return `trajectories` as a table.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        as_table([])  # without pandas, say so before the episodes
        return as_table(self.trajectories(episodes, seed=seed, per=per))

    @isolated()
    def export(self, folder: str | Path) -> Mapping[str, Any]:
        """Write the policy for a robot, as ``scilab-rl export --policy`` does.

        Args:
            folder: Gets the policy for NumPy and ONNX, its runtime and its contract.

        Returns:
            How exactly the written policy acts as the agent.

        Raises:
            ConfigError: If such a policy cannot be written.
        """
        from scilab_rl.deployment.export import write_policy

        return write_policy(self.run, self.policy, Path(folder))

    def close(self) -> None:
        """Close the environment."""
        if "_player" in vars(self):
            self.env.close()

    @functools.cached_property
    def inspector(self) -> AgentInspector:
        """Answers questions about single steps, see `scilab_rl.learning.inspector`."""
        from scilab_rl.learning.inspector import AgentInspector

        return AgentInspector(self.algorithm)

    @functools.cached_property
    @isolated()
    def _player(self) -> tuple[VecEnv, Algorithm]:
        return load_player(self.cfg, self.policy, record=False)

    @functools.cached_property
    def _conversions(self) -> tuple[Conversion, Conversion]:
        from scilab_rl.canonical_spaces import conversions

        return conversions(self.env)

    def _as_batch(self, observation: Observation) -> tuple[Observation, bool]:
        """Return the observation as a batch, and whether it was a single one."""
        if self.inspector.reason:
            raise ConfigError(self.inspector.reason)
        return as_batch(observation, self.observation_space)

    def _require(self, name: str) -> Probe:
        algorithm_name = self.cfg.algorithm.name
        shown = resolve_metrics(
            [name], self.inspector, (), key="probe", algorithm_name=algorithm_name
        )
        return shown.probes[0]

    def _film(
        self, env: VecEnv, algorithm: Algorithm, metrics: Sequence[str] | None, seed: int
    ) -> Callable[[], Replay]:
        """Prepare the recording of the next episode and return the function that ends it."""
        from scilab_rl.learning.inspector import AgentInspector
        from scilab_rl.recording.callback import default_metrics, film_first_episode
        from scilab_rl.recording.records import FOLDER, SUFFIX, ClipInfo
        from scilab_rl.training.checkpoint import saved_step

        folder = self.run.outputs / FOLDER
        number = len(list(folder.glob(f"play_*{SUFFIX}"))) + 1
        cfg, run = self.cfg, str(self.run) if self.run.is_agent else self.run.path.name
        name, step = self.policy.name.removeprefix("rl_model_"), saved_step(self.policy)
        policy = name if step is None else f"{name}, after {step:,} steps"
        clip = ClipInfo(
            f"play_{number:03d}", "eval", 0, cfg.env, cfg.algorithm.name, 0.0, (), run, seed, policy
        )
        names = default_metrics(AgentInspector(algorithm)) if metrics is None else metrics
        timeline, recorder = film_first_episode(env, algorithm, names, clip, folder)

        def finish() -> Replay:
            timeline.close()
            recorder.close()
            return Replay(folder / f"{clip.name}.html")

        return finish


def as_batch(observation: Observation, space: gymnasium.Space) -> tuple[Observation, bool]:
    """Return an observation as a batch of the space's type, and whether it was a single one.

    Raises:
        ConfigError: If it is neither one of the space nor a batch of them.
    """
    parts = getattr(space, "spaces", None)
    if parts is None:
        return _array_batch(observation, space, "The observation")
    if not isinstance(observation, Mapping):
        raise ConfigError(f"The observation must be a dictionary of {', '.join(parts)}.")
    if missing := [key for key in parts if key not in observation]:
        raise ConfigError(
            f"The observation has no '{missing[0]}': the agent reads {', '.join(parts)}."
        )
    found = {key: _array_batch(observation[key], parts[key], f"'{key}'") for key in parts}
    kinds = {is_single for _, is_single in found.values()}
    if len(kinds) > 1:
        raise ConfigError("Some entries of the observation are batches and some are not.")
    return {key: batch for key, (batch, _) in found.items()}, kinds.pop()


def _array_batch(value: object, space: gymnasium.Space, name: str) -> tuple[np.ndarray, bool]:
    array, shape = np.asarray(value, dtype=space.dtype), space.shape or ()
    if array.shape == shape:
        return array[None], True
    if array.shape[1:] == shape and array.ndim:
        return array, False
    raise ConfigError(
        f"{name} has the shape {array.shape}, but the agent reads {shape}, or {('batch', *shape)}."
    )


def _summary(
    evaluation: Evaluation, replay: Replay | None, *, reports_success: bool
) -> EvaluationSummary:
    values = evaluation.metrics(reports_success=reports_success)
    n = len(evaluation.episodes)
    rate = values.get("eval/success_rate")
    returns = np.array([sum(episode.rewards) for episode in evaluation.episodes])
    return EvaluationSummary(
        n,
        None if rate is None else success_interval(round(rate * n), n),
        aggregate([returns], "mean"),
        returns,
        np.array([len(episode.rewards) for episode in evaluation.episodes]),
        values,
        replay,
    )
