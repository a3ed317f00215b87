"""The contract test of every algorithm.

An algorithm of your own takes it with three lines in a test file:

.. code-block:: python

    from scilab_rl.testing.algorithms import AlgorithmContract

    class TestMyIdea(AlgorithmContract):
        algorithm = "my_idea"  # conf/algorithm/my_idea.yaml

It runs in an environment of a few microseconds per step, with small networks and batches. The
environment variable ``SCILAB_RL_TEST_DEVICE=cuda`` moves it from the CPU to a GPU.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import inspect
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from scilab_rl.config.classes import find_target
from scilab_rl.config.compose import compose
from scilab_rl.config.schema import AlgorithmConfig, RunConfig
from scilab_rl.config.workspace import open_project
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.vec_step import Observation
from scilab_rl.envs.vectorize import make_single_env, make_train_env, observed_layer
from scilab_rl.errors import ConfigError
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.arguments import DATA, FRAMEWORK_PARAMETERS, allowed_arguments
from scilab_rl.learning.compatibility import check_pair
from scilab_rl.learning.declared import declared_metrics, differences
from scilab_rl.metrics.logger import MetricLogger, as_number
from scilab_rl.run.checks import prepare_torch
from scilab_rl.run.demonstrations import collect_demos, prepare_demos
from scilab_rl.run.parts import make_algorithm
from scilab_rl.training import checkpoint
from scilab_rl.training.policy import load_policy, policy_state
from scilab_rl.training.snapshot import capture, random_state, restore, set_random_state

DEVICE_VARIABLE = "SCILAB_RL_TEST_DEVICE"
# In the order of preference: the first one whose spaces the algorithm takes.
_WITHOUT_GOALS = (
    "scilab_rl.testing:TinyBox-v0",
    "scilab_rl.testing:TinyDiscrete-v0",
    "HiddenGoal-v0",  # of cognitive models
    "TwoStep-v0",
)
_CANDIDATES = (
    "scilab_rl.testing:TinyReach-v0",
    "scilab_rl.testing:TinyReachDiscrete-v0",
    *_WITHOUT_GOALS,
)
# Plumbing of Stable-Baselines3 and ours, which a YAML file may leave at its defaults.
_PLUMBING = {
    "demos",
    "intrinsic",
    "optimize_memory_usage",
    "rollout_buffer_class",
    "rollout_buffer_kwargs",
    "stats_window_size",
}
# Upper limits that keep the contract test short; used for those parameters that an algorithm has.
_SMALL_NUMBERS = {
    "batch_size": 16,
    "buffer_size": 2000,
    "learning_starts": 20,
    "n_epochs": 2,
    "target_update_interval": 20,
}
_SMALL_ROLLOUT = 16
_SMALL_NETWORK = [16, 16]
_SEED = 7
_N_STEPS = 200
_ALLOWED_GROWTH_BYTES = 16 * 2**20


class AlgorithmContract:
    """Subclass it, name an algorithm, and pytest does the rest.

    Attributes:
        algorithm: Name of a YAML in an ``algorithm/`` folder, or an algorithm's class.
        arguments: Keyword arguments that win over the YAML and over the small values of the
            contract test.
        env: Id of an environment; None picks a tiny one that fits the algorithm.
    """

    algorithm: str | type
    arguments: Mapping[str, object] = {}
    env: str | None = None

    def test_yaml_lists_the_constructors_parameters(self) -> None:
        """A reader of the YAML sees every parameter, and nothing that does not exist."""
        if not isinstance(self.algorithm, str):
            pytest.skip("a class without YAML")
        cls, given = self._class(), set(_composed(self.algorithm).arguments)
        wanted = set(allowed_arguments(cls))
        assert given <= wanted, f"no parameters of {cls.__name__}: {sorted(given - wanted)}"
        missing = wanted - given - _PLUMBING - set(FRAMEWORK_PARAMETERS)
        assert not missing, f"parameters that the YAML does not list: {sorted(missing)}"

    def test_learns_for_the_steps_it_is_given(self) -> None:
        """`learn` ends at the first rollout boundary at or after the wanted step."""
        model = self.build()
        assert model.learn(_N_STEPS, callback=_Recorder(), log_interval=None) is model
        assert _N_STEPS <= model.num_timesteps <= _N_STEPS + 2 * _SMALL_ROLLOUT

    def test_same_seed_same_weights(self) -> None:
        """Two runs are equal to the last bit, and another seed gives another run."""
        first, second, other = (self.trained(seed=seed) for seed in (_SEED, _SEED, _SEED + 1))
        assert _differences(first, second) == []
        assert _differences(first, other) != []

    def test_saved_policy_predicts_the_same(self, tmp_path: Path) -> None:
        """The saved policy is all there is to know: another seed at loading changes nothing."""
        model = self.trained()
        checkpoint.save(
            capture(policy_state(model), with_buffers=False), tmp_path / "policy", step=_N_STEPS
        )
        loaded = self.build(seed=_SEED + 1)
        load_policy(loaded, tmp_path / "policy")
        observations = self._observations()
        assert np.array_equal(_act(model, observations), _act(loaded, observations))
        assert _unequal(_weights(model), _weights(loaded)) == []

    def test_continues_as_if_it_had_not_been_interrupted(self, tmp_path: Path) -> None:
        """After a load it learns on, and ends with the very weights of the uninterrupted run."""
        uninterrupted = self.build(n_envs=2)
        interruption = _Interruption(
            uninterrupted, tmp_path / "checkpoint", after_n_steps=_N_STEPS // 2
        )
        uninterrupted.learn(_N_STEPS, callback=interruption, log_interval=None)
        assert interruption.step is not None, "callback.on_rollout_start() is never called"

        resumed = self.build(n_envs=2)
        interruption.resume(resumed)
        at_load = _weights(resumed)
        resumed.learn(
            _N_STEPS - interruption.step,
            callback=_Recorder(),
            log_interval=None,
            reset_num_timesteps=False,
        )
        assert resumed.num_timesteps == uninterrupted.num_timesteps
        assert _differences(uninterrupted, resumed) == []
        if _learns(resumed):
            assert _unequal(at_load, _weights(resumed)) != [], "nothing was learned after the load"

    def test_calls_the_callback_at_every_step(self) -> None:
        """The framework evaluates, records and stops in the callback."""
        model, recorder = self.build(n_envs=2), _Recorder()
        model.learn(_N_STEPS, callback=recorder, log_interval=None)
        assert recorder.steps == list(range(2, model.num_timesteps + 1, 2))
        assert recorder.n_starts == recorder.n_ends == 1

    def test_stops_within_one_step_when_asked(self) -> None:
        """``on_step`` returning False ends `learn` before the next step."""
        model = self.build()
        model.learn(_N_STEPS, callback=_Recorder(stop_at=50), log_interval=None)
        assert model.num_timesteps == 50

    def test_records_finite_metrics(self) -> None:
        """Whatever learns says how: at least one ``train/`` metric, and each a finite number."""
        model, logger = self.build(), MetricLogger()
        model.set_logger(logger)
        model.learn(_N_STEPS, callback=_Recorder(), log_interval=None)
        recorded = {key: as_number(value) for key, value in logger.name_to_value.items()}
        numbers = {key: value for key, value in recorded.items() if value is not None}
        assert [key for key, value in numbers.items() if not math.isfinite(value)] == []
        assert not _learns(model) or any(key.startswith("train/") for key in numbers)

    def test_records_what_it_declares(self) -> None:
        """A misspelled metric can be refused at the start, because the class names its own."""
        model, logger = self.build(), _NamingLogger()
        model.set_logger(logger)
        model.learn(_N_STEPS, callback=_Recorder(), log_interval=None)
        intrinsic = {metric.name for metric in declared_metrics(type(_intrinsic_of(model)))}
        lines = differences(model, logger.names - intrinsic)
        assert not lines, "\n".join(lines)

    def test_predict_has_the_usual_signature(self) -> None:
        """As in Stable-Baselines3: one observation or several, actions within the action space."""
        model = self.build(n_envs=3)
        names = list(inspect.signature(model.predict).parameters)
        assert names[:4] == ["observation", "state", "episode_start", "deterministic"]
        space = model.get_env().action_space
        observations = self._observations(n_envs=3)
        actions, state = model.predict(observations, deterministic=True)
        assert state is None or isinstance(state, tuple)
        assert np.shape(actions) == (3, *(space.shape or ()))
        one = _map(observations, lambda values: values[0])
        for deterministic in (True, False):
            action = np.asarray(model.predict(one, deterministic=deterministic)[0])
            assert action.shape == space.shape
            assert space.contains(action.astype(space.dtype))

    def test_deterministic_prediction_repeats(self) -> None:
        """The same observation gives the same action, and draws no random number."""
        model, observations = self.build(), self._observations()
        if not _learns(model):
            pytest.skip("nothing learned, nothing to repeat")
        before = _generators()
        assert np.array_equal(_act(model, observations), _act(model, observations))
        assert _generators() == before

    def test_predict_leaves_observations_unchanged(self) -> None:
        """Others keep references to the same arrays: replay buffers, observers."""
        model, observations = self.build(), self._observations()
        copies = _map(observations, np.copy)
        model.predict(observations, deterministic=False)
        assert _unequal(_named(observations), _named(copies)) == []

    def test_learns_in_several_environments(self) -> None:
        """With three environments a step counts three times."""
        model = self.trained(n_envs=3)
        assert model.num_timesteps >= _N_STEPS
        assert model.num_timesteps % 3 == 0
        if _learns(model):
            assert _unequal(_weights(self.build(n_envs=3)), _weights(model)) != []

    @pytest.mark.slow
    def test_memory_does_not_grow(self) -> None:
        """Ten thousand steps, after a warm-up that has filled the buffers."""
        psutil = pytest.importorskip("psutil")
        model, process = self.build(), psutil.Process()
        model.learn(3000, callback=_Recorder(), log_interval=None)
        gc.collect()
        before = process.memory_info().rss
        model.learn(10_000, callback=_Recorder(), log_interval=None, reset_num_timesteps=False)
        gc.collect()
        assert process.memory_info().rss - before < _ALLOWED_GROWTH_BYTES

    def build(self, *, n_envs: int = 1, seed: int = _SEED) -> Algorithm:
        """Build the algorithm as a run does, with small networks and batches."""
        cfg = self._configuration(n_envs, seed)
        prepare_torch(cfg)
        model = make_algorithm(cfg, make_train_env(cfg))
        prepare_demos(cfg, model)
        collect_demos(cfg, model)
        model.set_logger(MetricLogger())
        return model

    def trained(self, *, n_envs: int = 1, seed: int = _SEED) -> Algorithm:
        """Build the algorithm and let it learn for 200 steps."""
        model = self.build(n_envs=n_envs, seed=seed)
        model.learn(_N_STEPS, callback=_Recorder(), log_interval=None)
        return model

    def _configuration(self, n_envs: int, seed: int) -> RunConfig:
        cls = self._class()
        algorithm = AlgorithmConfig(cls.__name__, f"{cls.__module__}.{cls.__qualname__}")
        if isinstance(self.algorithm, str):
            algorithm = _composed(self.algorithm)
        given = algorithm.arguments
        arguments = {**given, **_small(cls, given), **self.arguments}
        return RunConfig(
            env=resolve_env_id(self.env or fitting_environment(cls))[0],
            n_envs=n_envs,
            seed=seed,
            device=os.environ.get(DEVICE_VARIABLE, "cpu"),
            algorithm=dataclasses.replace(algorithm, arguments=arguments),
        )

    def _class(self) -> type:
        if isinstance(self.algorithm, type):
            return self.algorithm
        cls: type = find_target(_composed(self.algorithm).target, "algorithm._target_")
        return cls

    def _observations(self, n_envs: int = 1) -> Observation:
        return make_train_env(self._configuration(n_envs, _SEED + 2)).reset()  # type: ignore[return-value]


def fitting_environment(cls: type, *, with_goals: bool = True) -> str:
    """Return the id of the first tiny environment that an algorithm class can learn in.

    Args:
        cls: The class.
        with_goals: Whether environments with goals count too.

    Raises:
        ConfigError: If there is none.
    """
    for env_id in _CANDIDATES if with_goals else _WITHOUT_GOALS:
        try:
            check_pair(cls.__name__, cls, env_id, make_single_env(RunConfig(env_id)))
        except ConfigError as error:
            refusal = error
            continue
        return env_id
    raise refusal


class _NamingLogger(MetricLogger):
    """Collects the names that an algorithm records, also those that are not watched."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def record(self, key: str, value: object, exclude: object = None) -> None:
        self.names.add(key)
        super().record(key, value)

    def record_mean(self, key: str, value: float | None, exclude: object = None) -> None:
        self.names.add(key)
        super().record_mean(key, value)

    def record_lazy(self, key: str, function: Callable[[], object]) -> None:
        self.names.add(key)
        super().record_lazy(key, function)


def _intrinsic_of(model: Algorithm) -> object:
    return getattr(model, "intrinsic", None)


class _Recorder(BaseCallback):
    """Notes the calls, and asks to stop at a step."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.stop_at = stop_at
        self.steps: list[int] = []
        self.n_starts = self.n_ends = 0

    def _on_training_start(self) -> None:
        self.n_starts += 1

    def _on_training_end(self) -> None:
        self.n_ends += 1

    def _on_step(self) -> bool:
        self.steps.append(self.num_timesteps)
        return self.stop_at is None or self.num_timesteps < self.stop_at


class _Interruption(BaseCallback):
    """Saves everything at the first rollout that begins after some steps, and continues."""

    def __init__(self, model: Algorithm, directory: Path, after_n_steps: int) -> None:
        super().__init__()
        self.algorithm = model
        self.directory = directory
        self.after_n_steps = after_n_steps
        self.step: int | None = None

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.step is not None or self.algorithm.num_timesteps < self.after_n_steps:
            return
        self.step = self.algorithm.num_timesteps
        env = observed_layer(self.algorithm.get_env())
        state = {
            "algorithm": self.algorithm,
            "environments": env.env_method("episode_state"),
            "observed": env.state(),
            "random": random_state(),
        }
        checkpoint.save(capture(state), self.directory, step=self.step)

    def resume(self, model: Algorithm) -> None:
        """Bring a freshly built algorithm and its environments to the saved place."""
        rebuilt = {"algorithm": model, "environments": None, "observed": None, "random": None}
        saved = restore(rebuilt, checkpoint.load(self.directory))
        env = observed_layer(model.get_env())
        for index, episode in enumerate(saved["environments"]):
            env.env_method("replay_episode", episode, indices=index)
        env.continue_from(saved["observed"])
        set_random_state(saved["random"])


@functools.cache
def _composed(algorithm: str) -> AlgorithmConfig:
    open_project()
    return compose([f"algorithm={algorithm}", "tuned=false"]).algorithm


def _small(cls: type, given: Mapping[str, Any]) -> dict[str, object]:
    """Return smaller values for those parameters of an algorithm that make it slow."""
    allowed = allowed_arguments(cls)
    limits = dict(_SMALL_NUMBERS)
    if "buffer_size" not in allowed:  # elsewhere n_steps is the n of n-step returns
        limits["n_steps"] = _SMALL_ROLLOUT
    small: dict[str, object] = {
        name: min(limit, given[name]) if isinstance(given.get(name), (int, float)) else limit
        for name, limit in limits.items()
        if name in allowed
    }
    if getattr(cls, "learns_offline", False):
        small[DATA] = "random:20"
    if "policy_kwargs" in allowed:
        small["policy_kwargs"] = {**(given.get("policy_kwargs") or {}), "net_arch": _SMALL_NETWORK}
    if "net_arch" in allowed:
        small["net_arch"] = _SMALL_NETWORK
    return small


def _act(model: Algorithm, observations: Observation) -> np.ndarray:
    return np.asarray(model.predict(observations, deterministic=True)[0])


def _generators() -> str:
    """Return the state of the global random generators, to be compared."""
    state = random_state()
    return repr(state | {"torch": state["torch"].tolist()})


def _learns(model: Algorithm) -> bool:
    return bool(_weights(model))


def _weights(model: Algorithm) -> dict[str, np.ndarray]:
    """Return copies of all tensors: parameters, target networks, optimizer moments."""
    tensors = capture({"algorithm": model}, with_buffers=False).tensors
    return {name: tensor.cpu().numpy().copy() for name, tensor in tensors.items()}


def _differences(one: Algorithm, other: Algorithm) -> list[str]:
    """Compare all tensors and arrays of two algorithms, replay buffers included."""
    states = []
    for model in (one, other):
        arrays = capture({"algorithm": model}).arrays
        states.append(
            {**_weights(model), **{key: np.array(array) for key, array in arrays.items()}}
        )
    return _unequal(*states)


def _unequal(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> list[str]:
    """Return the names of arrays that only one has, or that differ in a bit."""
    names = set(one) | set(other)
    return sorted(
        name
        for name in names
        if name not in one or name not in other or one[name].tobytes() != other[name].tobytes()
    )


def _map(observations: Observation, change: Callable[[np.ndarray], np.ndarray]) -> Observation:
    if isinstance(observations, dict):
        return {key: change(values) for key, values in observations.items()}
    return change(observations)


def _named(observations: Observation) -> dict[str, np.ndarray]:
    return observations if isinstance(observations, dict) else {"observation": observations}
