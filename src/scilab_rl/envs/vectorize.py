"""Making the environments of a run's configuration."""

from __future__ import annotations

import importlib
import inspect
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    unwrap_vec_normalize,
    unwrap_vec_wrapper,
)

from scilab_rl.canonical_spaces import with_canonical_spaces
from scilab_rl.config.classes import build
from scilab_rl.config.schema import RunConfig
from scilab_rl.config.workspace import PROJECT_ENVS
from scilab_rl.envs.frames import simulator_state
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.refused_wrappers import refuse_order, refuse_wrapper
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.run_env import IGNORE, RunEnv
from scilab_rl.envs.stability import guard
from scilab_rl.envs.threads import ThreadsVecEnv
from scilab_rl.envs.workers import WorkersVecEnv
from scilab_rl.errors import ConfigError, EnvironmentFailure, ScilabRLError, did_you_mean
from scilab_rl.machine import n_cores
from scilab_rl.seeding import derive_seed
from scilab_rl.space_checks import check_observations

Wrapper = Callable[..., Any]
_log = logging.getLogger(__name__)


def make_train_env(cfg: RunConfig, render_mode: str | None = None) -> VecEnv:
    """Make the environments that the algorithm learns in.

    Args:
        cfg: The configuration of the run.
        render_mode: ``rgb_array`` or ``human`` when frames are wanted.
    """
    return _make(cfg, "train", render_mode)


def make_eval_env(cfg: RunConfig, render_mode: str | None = None, n_envs: int = 1) -> VecEnv:
    """Make the environment for evaluation, with its own stream of seeds.

    Args:
        cfg: The configuration of the run.
        render_mode: ``rgb_array`` or ``human`` when frames are wanted.
        n_envs: More than one are stepped side by side, by threads where MuJoCo simulates them.
    """
    cfg = for_evaluation(cfg)
    if n_envs > 1:
        cfg = replace(cfg, n_envs=n_envs)
        cfg = replace(cfg, vector="threads") if _is_simulated_by_mujoco(cfg) else cfg
    env = _make(cfg, "eval", render_mode)
    if (normalization := unwrap_vec_normalize(env)) is not None:
        normalization.training = normalization.norm_reward = False  # measure, don't adapt
    return env


def for_evaluation(cfg: RunConfig) -> RunConfig:
    """Return the configuration of the single environment for evaluation.

    What only changes rewards, to learn better, does not change what is measured.
    """
    wrappers = [wrapper for wrapper in _wrappers(cfg) if not _is_a(wrapper, gym.RewardWrapper)]
    return replace(cfg, n_envs=1, vector="inprocess", wrappers=wrappers)


def make_copies(cfg: RunConfig, n: int, render_mode: str | None = None) -> list[RunEnv]:
    """Make several of the environment for evaluation, without the layers of a vector of them."""
    cfg = for_evaluation(cfg)
    return [make_single_env(cfg, render_mode) for _ in range(n)]


def make_single_env(
    cfg: RunConfig, render_mode: str | None = None, *, in_worker: bool = False
) -> RunEnv:
    """Make one environment with its per-environment wrappers; also called in worker processes."""
    resolve_env_id(cfg.env)  # registers its suite
    try:
        env = guard(_registered_env(cfg, render_mode))
        if cfg.fast_fetch and "gymnasium_robotics" in sys.modules:
            from scilab_rl.envs.fast_fetch import speed_up  # imports MuJoCo

            speed_up(env)
        for wrapper in _wrappers(cfg):
            if not _wraps_vectors(wrapper):
                env = wrapper(env)
    except ScilabRLError:
        raise
    except TypeError as error:
        raise ConfigError(_explain_type_error(cfg, error)) from error
    except Exception as error:
        raise EnvironmentFailure(
            f"{cfg.env} cannot be made: {type(error).__name__}: {error}"
        ) from error
    return RunEnv(env, cfg.on_nan, in_worker=in_worker, view=cfg.render_view)


def _registered_env(cfg: RunConfig, render_mode: str | None) -> gym.Env:
    """Make the environment; one that does not know our way of drawing is made without it."""
    rendering = {"render_mode": render_mode} if render_mode else {}
    try:
        return gym.make(cfg.env, **(rendering | dict(cfg.env_kwargs)))
    except Exception:
        if render_mode != "rgb_array":
            raise
    return gym.make(cfg.env, **cfg.env_kwargs)


def _make_in_worker(cfg: RunConfig, render_mode: str | None, modules: Sequence[str]) -> gym.Env:
    # Ctrl-C on the terminal reaches all processes; the main one says when it is time to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for module in modules:  # they register environments
        importlib.import_module(module)
    return _make_readable(cfg, render_mode, in_worker=True)


def _make_readable(cfg: RunConfig, render_mode: str | None, *, in_worker: bool = False) -> gym.Env:
    env = make_single_env(cfg, render_mode, in_worker=in_worker)
    check_observations(cfg.env, env.observation_space)
    return env


def _make_in_thread(cfg: RunConfig, render_mode: str | None) -> gym.Env:
    env = _make_readable(cfg, render_mode)
    if simulator_state(env) is None:
        raise ConfigError(
            f"vector=threads is for environments that are simulated by MuJoCo, and {cfg.env} is "
            "not. Use vector=workers or vector=inprocess."
        )
    return env


def _is_simulated_by_mujoco(cfg: RunConfig) -> bool:
    env = make_single_env(cfg)
    try:
        return simulator_state(env) is not None
    finally:
        env.close()


def observed_layer(env: VecEnv) -> ObservedVecEnv:
    """Return the layer of a vector environment that shows its steps."""
    layer = unwrap_vec_wrapper(env, ObservedVecEnv)
    assert layer is not None  # `make_train_env` and `make_eval_env` add it
    return layer


def _make(cfg: RunConfig, phase: str, render_mode: str | None) -> VecEnv:
    wrappers = _wrappers(cfg)
    for wrapper in wrappers:
        refuse_wrapper(wrapper)
    refuse_order(wrappers)
    env = _make_vector(cfg, render_mode)
    env = ObservedVecEnv(env, phase, cfg.env, seed=cfg.seed, allows_nan=cfg.on_nan == IGNORE)
    env = with_canonical_spaces(env)
    for wrapper in wrappers:
        if _wraps_vectors(wrapper):
            env = wrapper(env)
    env.seed(derive_seed(cfg.seed, phase))
    if wrappers and phase == "train":
        _tell_unknown_memory(env)
        _tell_unshared_memory(wrappers)
    return env


def _make_vector(cfg: RunConfig, render_mode: str | None) -> VecEnv:
    """Make the environments, side by side as the configuration says."""
    n_cpu = min(cfg.n_envs, n_cores())
    if cfg.vector == "inprocess" or cfg.n_envs == 1:
        return DummyVecEnv([partial(_make_readable, cfg, render_mode)] * cfg.n_envs)
    if cfg.vector == "threads":
        return ThreadsVecEnv([partial(_make_in_thread, cfg, render_mode)] * cfg.n_envs, n_cpu)
    modules = [PROJECT_ENVS] if PROJECT_ENVS in sys.modules else []
    return WorkersVecEnv(
        [partial(_make_in_worker, cfg, render_mode, modules)] * cfg.n_envs,
        cfg.n_envs if cfg.vector == "subprocess" else n_cpu,
        start_method=os.environ.get("SCILAB_RL_START_METHOD"),
    )


def _tell_unshared_memory(wrappers: Sequence[Wrapper]) -> None:
    targets = [getattr(w, "func", w) for w in wrappers if _wraps_vectors(w)]
    own = [t for t in targets if not t.__module__.startswith(("stable_baselines3", "scilab_"))]
    if own:
        _log.warning(
            "The state of %s is in checkpoints, but neither in policies nor in the evaluation, "
            "which begin without it. That of a gymnasium.Wrapper is shared and saved.",
            ", ".join(target.__name__ for target in own),
        )


def _tell_unknown_memory(env: VecEnv) -> None:
    unknown = env.env_method("unknown_memory", indices=0)[0]
    if unknown:
        _log.warning(
            "The wrappers have attributes that cannot be saved: %s. If they change while training, "
            "a resumed or played run differs. Numbers, text, arrays and containers of them are "
            "saved.",
            ", ".join(unknown),
        )


def _wrappers(cfg: RunConfig) -> list[Wrapper]:
    """Return the wrappers, each as a function of what it wraps."""
    return [w if callable(w) else build(w, "wrappers", is_partial=True) for w in cfg.wrappers]


def _wraps_vectors(wrapper: Wrapper) -> bool:
    return _is_a(wrapper, VecEnvWrapper)


def _is_a(wrapper: Wrapper, base: type) -> bool:
    target = getattr(wrapper, "func", wrapper)
    return inspect.isclass(target) and issubclass(target, base)


def _explain_type_error(cfg: RunConfig, error: TypeError) -> str:
    """Name the unknown keyword argument, when that is what the error is about."""
    for name in cfg.env_kwargs:
        if f"'{name}'" in str(error):
            allowed = _keyword_arguments(cfg.env)
            return (
                f"{cfg.env} takes no env_kwargs.{name}.{did_you_mean(name, allowed)} "
                f"It takes: {', '.join(allowed) or 'none'}."
            )
    return f"{cfg.env} cannot be made with these env_kwargs and wrappers: {error}."


def _keyword_arguments(env_id: str) -> list[str]:
    entry_point: Any = gym.spec(env_id.rpartition(":")[2]).entry_point
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
