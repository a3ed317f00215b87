"""A finished run's policy, loaded to act again: to play, to be measured, or to be probed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import RunConfig
from scilab_rl.run.checks import complete, prepare_torch
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory, reports_success
from scilab_rl.run.parts import make_algorithm, render_mode
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:  # heavy
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.learning.algorithm import Algorithm

_SMALL_BUFFER = 1000


def load_player(
    cfg: RunConfig, folder: Path, *, record: bool, n_envs: int = 1, buffer_size: int = _SMALL_BUFFER
) -> tuple[VecEnv, Algorithm]:
    """Make the evaluation environment of a run and the algorithm with its saved weights.

    Args:
        cfg: The configuration of the run.
        folder: The saved policy.
        record: Whether its episodes are filmed.
        n_envs: How many environments, side by side.
        buffer_size: Most transitions of a replay buffer; a policy that only acts needs few.
    """
    cfg = complete(cfg)
    prepare_torch(cfg)
    mode = render_mode("record" if record else "none")
    return _load(cfg, folder, mode, n_envs, buffer_size)


def measure_run(directory: RunDirectory, n_episodes: int) -> dict[str, float]:
    """Evaluate the finished policy of a run in episodes that the run has never seen.

    Args:
        directory: The run.
        n_episodes: How many episodes.

    Returns:
        The metrics, by the names of an evaluation.
    """
    from scilab_rl.training.evaluation import evaluate
    from scilab_rl.training.policy import FINISHED

    cfg = complete(load_recorded(directory / CONFIG_FILE))
    env, algorithm = _load(cfg, directory / FINISHED, None)
    try:
        evaluation = evaluate(algorithm, env, n_episodes, derive_seed(cfg.seed, "measure"))
        return evaluation.metrics(reports_success=reports_success(directory))
    finally:
        env.close()


def _load(
    cfg: RunConfig,
    folder: Path,
    render_mode: str | None,
    n_envs: int = 1,
    buffer_size: int = _SMALL_BUFFER,
) -> tuple[VecEnv, Algorithm]:
    from scilab_rl.envs.vectorize import make_eval_env
    from scilab_rl.training.policy import load_policy

    env = make_eval_env(cfg, render_mode, n_envs)
    arguments = dict(cfg.algorithm.arguments)
    if "buffer_size" in arguments:
        arguments["buffer_size"] = min(arguments["buffer_size"], buffer_size)
    algorithm = make_algorithm(
        replace(cfg, algorithm=replace(cfg.algorithm, arguments=arguments)), env
    )
    load_policy(algorithm, folder)
    return env, algorithm
