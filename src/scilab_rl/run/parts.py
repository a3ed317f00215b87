"""From the configuration to the parts of a run: environments, algorithm, trackers."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from scilab_rl.config.classes import build, find_target
from scilab_rl.config.schema import RunConfig, is_enabled
from scilab_rl.config.workspace import config_files
from scilab_rl.errors import ConfigError, RenderingError
from scilab_rl.run.checks import algorithm_class
from scilab_rl.run.directory import CONFIG_FILE, find_named_run, find_policy, policy_path
from scilab_rl.tracking.background import BackgroundTracker
from scilab_rl.tracking.base import Tracker, TrackerGroup
from scilab_rl.tracking.files import FilesTracker

if TYPE_CHECKING:  # heavy
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.learning.algorithm import Algorithm

_log = logging.getLogger(__name__)


def make_environments(cfg: RunConfig) -> tuple[VecEnv, VecEnv]:
    """Make the training environments and the one for evaluation."""
    from scilab_rl.envs.vectorize import make_eval_env, make_train_env

    mode = render_mode(cfg.render)
    train_mode = None if mode == "human" else mode  # one window is enough
    return make_train_env(cfg, train_mode), make_eval_env(cfg, mode)


def render_mode(render: str) -> str | None:
    """Return the mode in which environments draw, and prepare for drawing without a display.

    Raises:
        ConfigError: If a window is requested and there is no display.
    """
    if render == "human":
        from scilab_rl.recording.live import has_display

        if not has_display():
            raise ConfigError(
                "render=human opens a window, and there is no display here. render=display shows "
                "the episodes in a browser, render=record keeps them as video."
            )
        return "human"
    if render == "none":
        return None
    from scilab_rl.recording.gl import choose_backend

    # MuJoCo reads the choice when it is imported. Other simulators may draw without OpenGL, so that
    # it is decided later whether a failure matters.
    with contextlib.suppress(RenderingError):
        choose_backend()
    return "rgb_array"


def make_algorithm(cfg: RunConfig, train_env: VecEnv) -> Algorithm:
    """Build the algorithm that ``algorithm._target_`` names.

    Raises:
        ConfigError: If it cannot learn in this environment.
    """
    from scilab_rl.building import build_algorithm
    from scilab_rl.learning.compatibility import check_pair
    from scilab_rl.learning.values import documented_values

    cls = algorithm_class(cfg)
    extractor = (cfg.algorithm.arguments.get("policy_kwargs") or {}).get("features_extractor_class")
    check_pair(
        cfg.algorithm.name, cls, cfg.env, train_env, lambda: _fitting_algorithms(train_env),
        own_extractor=extractor is not None,
    )  # fmt: skip
    arguments = documented_values(cls, cfg.algorithm.arguments, build)
    return build_algorithm(cls, arguments, train_env, seed=cfg.seed, device=cfg.device)


def restore_policy(cfg: RunConfig, algorithm: Algorithm) -> None:
    """Start from the saved policy, or the last one of the run, that ``restore_policy`` names."""
    if cfg.restore_policy is None:
        return
    from scilab_rl.training.policy import load_policy

    path = policy_path(cfg.restore_policy)
    if not path.exists() or (path / CONFIG_FILE).is_file():
        run = find_named_run(cfg.restore_policy, Path(cfg.base_logdir))
        path = path if run is None else find_policy(run, "finished", "best")
    load_policy(algorithm, path)
    _log.info("Policy restored from %s.", path)


def open_trackers(cfg: RunConfig) -> TrackerGroup:
    """Build the trackers that are switched on; all but files and console may fail."""
    trackers: list[Tracker] = [FilesTracker()]
    for name, tracker in cfg.tracking.items():
        if not isinstance(tracker, Mapping) or "_target_" not in tracker:
            raise ConfigError(f"tracking.{name} needs a _target_, but it is {tracker!r}.")
        if not is_enabled(tracker.get("enabled", True), package=name):
            continue
        built = build({k: v for k, v in tracker.items() if k != "enabled"}, f"tracking.{name}")
        trackers.append(built if name == "console" else BackgroundTracker(built, name))
    return TrackerGroup(trackers)


def _fitting_algorithms(env: VecEnv) -> list[str]:
    """Return the names of the algorithms whose class accepts these spaces."""
    from scilab_rl.learning.compatibility import check_pair

    fitting = []
    for name, path in config_files("algorithm").items():
        target = yaml.safe_load(path.read_text(encoding="utf-8"))["_target_"]
        try:
            check_pair(name, find_target(target, name), "", env)
        except ConfigError:
            continue
        fitting.append(name)
    return fitting
