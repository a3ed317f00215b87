"""Making vector environments from an id and a list of wrappers."""

from __future__ import annotations

import importlib
import inspect
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
)

from scilab_rl.envs.contract import IGNORE, STOP, ContractGuard
from scilab_rl.envs.frames import FrameCapture
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.replayable import ReplayableEpisode
from scilab_rl.envs.stability import guard
from scilab_rl.envs.workers import WorkersVecEnv
from scilab_rl.errors import ConfigError, EnvironmentError_, ScilabRLError, did_you_mean
from scilab_rl.machine import n_cores
from scilab_rl.seeding import derive_seed

Wrapper = Callable[..., Any]


@dataclass(frozen=True)
class EnvSettings:
    """How to make an environment; the same for training, evaluation and playing.

    Attributes:
        env_id: An id that ``gymnasium.make`` knows.
        env_kwargs: Keyword arguments of the environment.
        wrappers: Applied in order. A wrapper class of Gymnasium wraps each environment, one of
            Stable-Baselines3's ``VecEnvWrapper`` the vector of them.
        n_envs: How many run side by side.
        vector: ``inprocess``; ``subprocess``, a process each; or ``workers``, one per core, which
            share them.
        seed: Seed of the run.
        modules: Imported first, because they register environments.
        render_mode: ``rgb_array`` or ``human`` when frames are wanted.
        fast_fetch: Whether Fetch goes without its look-ups by name; the observations are the same.
        on_nan: ``stop``, ``end_episode`` or ``ignore``, see `contract.ContractGuard`.
    """

    env_id: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    wrappers: Sequence[Wrapper] = ()
    n_envs: int = 1
    vector: str = "inprocess"
    seed: int = 1
    modules: Sequence[str] = ()
    render_mode: str | None = None
    fast_fetch: bool = True
    on_nan: str = STOP


def make_train_env(settings: EnvSettings) -> VecEnv:
    """Make the environments that the algorithm learns in."""
    return _make(settings, "train")


def make_eval_env(settings: EnvSettings) -> VecEnv:
    """Make the single environment for evaluation, with its own stream of seeds."""
    env = _make(replace(settings, n_envs=1, vector="inprocess"), "eval")
    layer: Any = env
    while hasattr(layer, "venv"):
        if isinstance(layer, VecNormalize):  # measure, don't adapt; true rewards
            layer.training = False
            layer.norm_reward = False
        layer = layer.venv
    return env


def make_single_env(settings: EnvSettings, *, in_worker: bool = False) -> gym.Env:
    """Make one environment with its per-environment wrappers; also called in worker processes."""
    for module in settings.modules:
        importlib.import_module(module)
    resolve_env_id(settings.env_id)  # registers its suite
    try:
        # An environment that draws nothing need not have the parameter.
        rendering = {"render_mode": settings.render_mode} if settings.render_mode else {}
        env = gym.make(settings.env_id, **(rendering | dict(settings.env_kwargs)))
        env = guard(env)
        if settings.fast_fetch and "gymnasium_robotics" in sys.modules:
            from scilab_rl.envs.fast_fetch import speed_up  # brings MuJoCo with it

            speed_up(env)
        for wrapper in settings.wrappers:
            if not _wraps_vectors(wrapper):
                env = wrapper(env)
        if settings.render_mode == "rgb_array":
            env = FrameCapture(env)
    except ScilabRLError:
        raise
    except TypeError as error:
        raise ConfigError(_explain_type_error(settings, error)) from error
    except Exception as error:
        raise EnvironmentError_(
            f"{settings.env_id} cannot be made: {type(error).__name__}: {error}"
        ) from error
    return ReplayableEpisode(ContractGuard(env, settings.on_nan, in_worker=in_worker))


def _make_in_worker(settings: EnvSettings) -> gym.Env:
    # Ctrl-C on the terminal reaches all processes; the main one says when it is time to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return make_single_env(settings, in_worker=True)


def observed_layer(env: VecEnv) -> ObservedVecEnv:
    """Return the layer of a vector environment that shows its steps."""
    layer: Any = env
    while not isinstance(layer, ObservedVecEnv):
        layer = layer.venv
    return layer


def _make(settings: EnvSettings, phase: str) -> VecEnv:
    env: VecEnv
    n_workers = _n_workers(settings)
    if n_workers:
        env = WorkersVecEnv(
            [partial(_make_in_worker, settings)] * settings.n_envs,
            n_workers,
            start_method=os.environ.get("SCILAB_RL_START_METHOD"),
        )
    else:
        env = DummyVecEnv([partial(make_single_env, settings)] * settings.n_envs)
    env = ObservedVecEnv(
        env, phase, settings.env_id, seed=settings.seed, allows_nan=settings.on_nan == IGNORE
    )
    for wrapper in settings.wrappers:
        if _wraps_vectors(wrapper):
            env = wrapper(env)
    env.seed(derive_seed(settings.seed, phase))
    return env


def _n_workers(settings: EnvSettings) -> int:
    """Return how many processes share the environments; 0: the main process has them."""
    if settings.vector == "inprocess" or settings.n_envs == 1:
        return 0
    if settings.vector == "subprocess":
        return settings.n_envs
    return min(settings.n_envs, n_cores())


def _wraps_vectors(wrapper: Wrapper) -> bool:
    target = getattr(wrapper, "func", wrapper)
    return inspect.isclass(target) and issubclass(target, VecEnvWrapper)


def _explain_type_error(settings: EnvSettings, error: TypeError) -> str:
    """Name the unknown keyword argument, when that is what the error is about."""
    for name in settings.env_kwargs:
        if f"'{name}'" in str(error):
            allowed = _keyword_arguments(settings.env_id)
            return (
                f"{settings.env_id} takes no env_kwargs.{name}.{did_you_mean(name, allowed)} "
                f"It takes: {', '.join(allowed) or 'none'}."
            )
    return f"{settings.env_id} cannot be made with these env_kwargs and wrappers: {error}."


def _keyword_arguments(env_id: str) -> list[str]:
    entry_point: Any = gym.spec(env_id).entry_point
    if isinstance(entry_point, str):
        entry_point = load_env_creator(entry_point)
    parameters: dict[str, None] = {}
    for cls in getattr(entry_point, "__mro__", [entry_point])[:2]:
        signature = inspect.signature(cls.__init__ if inspect.isclass(cls) else cls)
        parameters |= dict.fromkeys(
            p.name
            for p in signature.parameters.values()
            if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)
        )
    return [name for name in parameters if name not in ("self", "render_mode")]
