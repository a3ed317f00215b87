"""Policies on disk: networks, optimizers, and what normalization and wrappers have learned."""

from __future__ import annotations

import logging
from pathlib import Path

from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization, unwrap_vec_normalize

from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.training import checkpoint, sb3_archives
from scilab_rl.training.snapshot import capture, restore

BEST, FINISHED, KEPT = "rl_model_best", "rl_model_finished", "rl_model_epoch_"
_MEMORY = "wrappers"
_log = logging.getLogger(__name__)


def policy_state(model: Algorithm) -> dict[str, object]:
    """Return the parts of a run that make a policy: the algorithm and its normalization."""
    state: dict[str, object] = {"algorithm": model}
    if (normalization := unwrap_vec_normalize(model.get_env())) is not None:
        # VecNormalize has obs_rms only where it normalizes observations.
        own = vars(normalization)
        state |= {name: own[name] for name in ("obs_rms", "ret_rms") if name in own}
    if memory := _wrapper_memory(model.get_env()):
        state[_MEMORY] = memory
    return state


def save_policy(model: Algorithm, directory: Path, epoch: int) -> None:
    """Save everything but the replay buffer; a failure is a warning.

    Args:
        model: The algorithm.
        directory: For example ``<run>/rl_model_best``.
        epoch: Completed epochs, for the manifest.
    """
    snapshot = capture(policy_state(model), with_buffers=False)
    try:
        checkpoint.save(snapshot, directory, step=model.num_timesteps, about={"epoch": epoch})
    except OSError as error:
        _log.warning(
            "The policy %s could not be saved: %s. Training continues.", directory.name, error
        )


def load_policy(model: Algorithm, directory: Path) -> None:
    """Put a saved policy, with its optimizers and normalization, into an algorithm.

    Args:
        model: The algorithm.
        directory: As `save_policy` writes it; or a zip of Stable-Baselines3, if the user trusts it.

    Raises:
        CheckpointError: If the policy is damaged or was saved by another algorithm.
        ConfigError: If there is none, or it is a zip that is not trusted.
    """
    if (archive := sb3_archives.find_archive(directory)) is not None:
        sb3_archives.load_archive(model, archive)
    else:
        restored = restore(policy_state(model) | {_MEMORY: None}, checkpoint.load(directory))
        if restored.get(_MEMORY):
            model.get_env().env_method("set_wrapper_memory", restored[_MEMORY])


def share_memory(train_env: VecEnv, eval_env: VecEnv) -> None:
    """Give an evaluation what normalization and wrappers of training environment 0 have learned."""
    if unwrap_vec_normalize(train_env) is not None:
        sync_envs_normalization(train_env, eval_env)
    if memory := _wrapper_memory(train_env):
        eval_env.env_method("set_wrapper_memory", memory)


def _wrapper_memory(env: VecEnv) -> dict[str, object]:
    if not env.has_attr("wrapper_memory"):
        return {}
    return env.env_method("wrapper_memory", indices=0)[0]
