"""From the configuration to the parts of a run: environments, algorithm, trackers."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf

from scilab_rl import config
from scilab_rl.errors import ConfigError, MissingDependencyError, RenderingError, did_you_mean
from scilab_rl.seeding import resolve_seed, seed_everything
from scilab_rl.tracking.base import TrackerGroup
from scilab_rl.tracking.files import FilesTracker
from scilab_rl.tracking.mirror import Mirror
from scilab_rl.workspace import DESK_ENVS, config_files

_log = logging.getLogger(__name__)


def complete(cfg: DictConfig) -> DictConfig:
    """Return the checked configuration with the environment's id, names and seed resolved."""
    from scilab_rl.envs.registration import resolve_env_id

    cfg = config.prepare(cfg)
    cfg.env, notice = resolve_env_id(cfg.env)
    if notice:
        _log.info(notice)
    cfg.seed = resolve_seed(cfg.seed)
    algorithm_class(cfg)
    if config.switched_on(cfg.wandb) and not importlib.util.find_spec("wandb"):
        raise MissingDependencyError("wandb", "wandb", "to track runs with Weights & Biases")
    if config.switched_on(cfg.tensorboard) and not importlib.util.find_spec("tensorboard"):
        raise MissingDependencyError("tensorboard", "tensorboard", "to write TensorBoard files")
    return cfg


def prepare_torch(cfg: DictConfig) -> None:
    """Set threads and seeds before anything draws a random number."""
    import torch

    _check_device(cfg.device)
    torch.set_num_threads(cfg.n_threads)
    seed_everything(cfg.seed)


def _check_device(name: str) -> None:
    """Refuse a device that is not here; some libraries would silently take the CPU instead."""
    import torch

    if name == "auto":
        return
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(
            f"device must be auto, cpu, cuda, cuda:NUMBER or mps, but it is {name!r}; device=cpu "
            "always works."
        ) from error
    n_devices = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= n_devices:
        raise ConfigError(
            f"device={name}: PyTorch finds {n_devices or 'no'} GPUs here. Use device=cpu or auto."
        )


def make_environments(cfg: DictConfig) -> tuple[Any, Any]:
    """Make the training environments and the one for evaluation."""
    from dataclasses import replace

    from scilab_rl.envs.vectorize import make_eval_env, make_train_env

    settings = env_settings(cfg)
    train_settings = replace(settings, render_mode=render_mode(cfg.render))
    if cfg.render == "human":  # one window is enough
        return make_train_env(settings), make_eval_env(train_settings)
    return make_train_env(train_settings), make_eval_env(train_settings)


def render_mode(render: str) -> str | None:
    """Return the mode in which environments draw, and prepare for drawing without a display.

    Raises:
        ConfigError: If a window is wanted and there is no display.
    """
    if render == "human":
        from scilab_rl.visualization.live import has_display

        if not has_display():
            raise ConfigError(
                "render=human opens a window, and there is no display here. render=display shows "
                "the episodes in a browser, render=record keeps them as video."
            )
        return "human"
    if render == "none":
        return None
    from scilab_rl.visualization.gl import choose_backend

    # MuJoCo reads the choice when it is imported. Other simulators may draw without OpenGL, so that
    # it is decided later whether a failure matters.
    with contextlib.suppress(RenderingError):
        choose_backend()
    return "rgb_array"


def env_settings(cfg: DictConfig) -> Any:
    """Return how to make the run's environments."""
    from scilab_rl.envs.vectorize import EnvSettings

    return EnvSettings(
        env_id=cfg.env,
        env_kwargs=OmegaConf.to_container(cfg.env_kwargs, resolve=True),  # type: ignore[arg-type]
        wrappers=[_partial(wrapper, "wrappers") for wrapper in cfg.wrappers],
        n_envs=cfg.n_envs,
        vector=cfg.vector,
        fast_fetch=cfg.fast_fetch,
        on_nan=cfg.on_nan,
        seed=cfg.seed,
        modules=[DESK_ENVS] if DESK_ENVS in sys.modules else [],
    )


def make_algorithm(cfg: DictConfig, train_env: Any) -> Any:
    """Build the algorithm that ``algorithm._target_`` names.

    Raises:
        ConfigError: If it cannot learn in this environment.
    """
    from scilab_rl.algorithms.build import build_algorithm
    from scilab_rl.algorithms.compatibility import check_pair

    cls = algorithm_class(cfg)
    check_pair(cfg.algorithm.name, cls, cfg.env, train_env, lambda: _fitting_algorithms(train_env))
    arguments = hydra.utils.instantiate(_arguments(cfg), _convert_="all")
    buffer = arguments.get("replay_buffer_class")
    if isinstance(buffer, str) and buffer not in ("auto", "her"):
        arguments["replay_buffer_class"] = hydra.utils.get_class(buffer)
    return build_algorithm(cls, arguments, train_env, seed=cfg.seed, device=cfg.device)


def algorithm_class(cfg: DictConfig) -> type:
    """Import the algorithm's class and check its keyword arguments.

    Raises:
        ConfigError: If there is no such class or parameter.
    """
    from scilab_rl.algorithms.arguments import check_arguments

    cls = _import_target(cfg.algorithm._target_, "algorithm")
    check_arguments(cfg.algorithm.get("name", cls.__name__), cls, _arguments(cfg))
    return cls


def restore_policy(cfg: DictConfig, algorithm: Any) -> None:
    """Start from the saved policy that ``restore_policy`` names, if it names one."""
    if cfg.restore_policy is None:
        return
    from scilab_rl.training.trainer import load_policy

    load_policy(algorithm, Path(cfg.restore_policy))
    _log.info("Policy restored from %s.", cfg.restore_policy)


def open_trackers(cfg: DictConfig) -> TrackerGroup:
    """Build the trackers that are switched on; all but files and console may fail."""
    trackers: list[Any] = [FilesTracker()]
    for name, tracker in cfg.tracking.items():
        if not config.switched_on(tracker.enabled, package=name):
            continue
        built = hydra.utils.instantiate({k: v for k, v in tracker.items() if k != "enabled"})
        trackers.append(built if name == "console" else Mirror(built, name))
    return TrackerGroup(trackers)


def _arguments(cfg: DictConfig) -> dict[str, Any]:
    container = OmegaConf.to_container(cfg.algorithm, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items() if key not in ("name", "_target_")}


def _partial(target: Any, key: str) -> Callable[..., Any]:
    """Return the class of a ``_target_`` entry with its arguments bound."""
    if not OmegaConf.is_config(target) or "_target_" not in target:
        raise ConfigError(f"Each entry of {key} needs a _target_, but there is {target!r}.")
    _import_target(target._target_, key)
    return hydra.utils.instantiate(target, _partial_=True, _convert_="all")


def _import_target(target: str, key: str) -> Any:
    """Import ``package.module.Class`` and explain what is missing when it fails."""
    module_name, _, name = target.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        if error.name in ("jax", "optax"):
            purpose = f"for the compiled algorithms, such as {module_name.rpartition('.')[2]}"
            raise MissingDependencyError(error.name, "jax", purpose) from error
        raise ConfigError(
            f"{key}._target_: '{target}' cannot be imported: {error}. The class in "
            f"src/custom_algorithms/my_idea.py is custom_algorithms.my_idea.CLASS."
        ) from error
    if not hasattr(module, name):
        classes = [word for word in vars(module) if isinstance(vars(module)[word], type)]
        raise ConfigError(
            f"{key}._target_: there is no '{name}' in {module_name}.{did_you_mean(name, classes)}"
        )
    return getattr(module, name)


def _fitting_algorithms(env: Any) -> list[str]:
    """Return the names of the algorithms whose class accepts these spaces."""
    from scilab_rl.algorithms.compatibility import check_pair

    fitting = []
    for name, path in config_files("algorithm").items():
        target = OmegaConf.to_container(OmegaConf.load(path))["_target_"]  # type: ignore[index,call-overload]
        try:
            check_pair(name, _import_target(target, name), "", env)
        except ConfigError:
            continue
        fitting.append(name)
    return fitting
