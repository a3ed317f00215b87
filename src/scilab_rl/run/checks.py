"""The checks of a composed configuration: whether a run can work, before anything is built."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Mapping
from dataclasses import replace

from scilab_rl.config.classes import find_target
from scilab_rl.config.schema import RunConfig, is_enabled
from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.metrics.triggers import parse_trigger
from scilab_rl.seeding import resolve_seed, seed_everything

_log = logging.getLogger(__name__)


def complete(cfg: RunConfig) -> RunConfig:
    """Return the checked configuration with the environment's id, names and seed resolved."""
    from scilab_rl.envs.registration import resolve_env_id

    env, notice = resolve_env_id(cfg.env)
    if notice:
        _log.info(notice)
    cfg = replace(cfg, env=env, seed=resolve_seed(cfg.seed))
    algorithm_class(cfg)
    if cfg.record_when is not None:
        parse_trigger(cfg.record_when)
    if is_enabled(cfg.wandb) and not importlib.util.find_spec("wandb"):
        raise MissingDependencyError("wandb", "wandb", "to track runs with Weights & Biases")
    if is_enabled(cfg.tensorboard) and not importlib.util.find_spec("tensorboard"):
        raise MissingDependencyError("tensorboard", "tensorboard", "to write TensorBoard files")
    return cfg


def prepare_torch(cfg: RunConfig) -> None:
    """Set threads and seeds before anything draws a random number."""
    import torch
    from threadpoolctl import threadpool_limits

    _check_device(cfg.device)
    torch.set_num_threads(cfg.n_threads)
    threadpool_limits(cfg.n_threads, user_api="blas")  # of NumPy; stays until the next call
    seed_everything(cfg.seed)


def _check_device(name: str) -> None:
    """Reject a device that is not here; some libraries would silently take the CPU instead."""
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


def algorithm_class(cfg: RunConfig) -> type:
    """Import the algorithm's class and check its keyword arguments.

    Raises:
        ConfigError: If there is no such class or parameter, or a value is invalid.
    """
    from scilab_rl.learning.arguments import check_arguments
    from scilab_rl.learning.values import documented_values

    cls = find_target(cfg.algorithm.target, "algorithm._target_")
    check_arguments(cfg.algorithm.name, cls, cfg.algorithm.arguments)
    documented_values(cls, cfg.algorithm.arguments, lambda value, _: value)
    return cls


def check_metrics(cfg: RunConfig, algorithm: object = None) -> None:
    """Reject metrics that the run never records, in the keys that name one.

    Args:
        cfg: The complete configuration.
        algorithm: The algorithm, which knows what its configuration makes it record; None: what
            its class declares for any configuration.

    Raises:
        ConfigError: With the metrics that there are.
    """
    from scilab_rl.algorithms.intrinsic.build import intrinsic_reward_class
    from scilab_rl.learning.arguments import INTRINSIC
    from scilab_rl.learning.declared import how_to_declare, possible_metrics, recorded_metrics
    from scilab_rl.metrics.names import check_recorded
    from scilab_rl.metrics.probes import is_known

    cls = algorithm_class(cfg)
    if algorithm is not None:
        recorded = recorded_metrics(algorithm)
    else:
        chosen = cfg.algorithm.arguments.get(INTRINSIC)
        name = chosen.get("name") if isinstance(chosen, Mapping) else chosen
        extra = [] if name is None else [intrinsic_reward_class(name)]
        recorded = possible_metrics(cls, *extra)
    named = [
        ("early_stop_data_column", cfg.early_stop_data_column),
        ("hyperopt_criterion", cfg.hyperopt_criterion),
    ]
    if cfg.render in ("record", "display"):
        metrics = [m for m in cfg.render_metrics_train if "/" in m and not is_known(m)]
        named += [("render_metrics_train", metric) for metric in metrics]
    for key, name in named:
        check_recorded(
            key,
            name,
            recorded.names,
            absent=recorded.absent,
            algorithm_name=cfg.algorithm.name,
            hint=how_to_declare(cls, name),
        )
