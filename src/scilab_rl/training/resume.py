"""Checkpoints of a run, and how it resumes from one as if it had not been interrupted."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.envs.types import Observation
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import CheckpointError
from scilab_rl.files import discard, fault_point, point_to, remove_unfinished
from scilab_rl.learning.algorithm import Algorithm
from scilab_rl.learning.observations import single
from scilab_rl.training import checkpoint
from scilab_rl.training.snapshot import RandomState, Snapshot, restore, set_random_state
from scilab_rl.training.state import RunState

FOLDER, LAST = "checkpoints", "last"
GENERATIONS = 2
_log = logging.getLogger(__name__)


def continue_from(snapshot: Snapshot, state: RunState) -> BaseCallback:
    """Bring a freshly built run to the state of a snapshot.

    Returns:
        A callback that must be the first one of `learn`.

    Raises:
        CheckpointError: If the snapshot is of another algorithm or environment.
    """
    model, parts = state.model, state.parts(with_episodes=False)
    # What has no counterpart in a fresh run is rebuilt from the description alone.
    for name in ("environments", "observed", "recorded", "random", "best"):
        parts[name] = None
    restored = restore(parts, snapshot)
    for layer, memory in zip(state.layers, restored.get("normalization", []), strict=False):
        vars(layer).update(memory)
    state.best = tuple(restored["best"]) if restored["best"] is not None else None
    state.logger.set_state(restored["recorded"])
    env = observed_layer(model.get_env())
    if not _replay_episodes(env, restored["environments"], restored["observed"]):
        _begin_new_episodes(model)
    # Replaying draws no numbers from the global generators; they come last to be sure.
    set_random_state(restored["random"])
    return _UndoPreparations(model, restored["random"])


def save(snapshot: Snapshot, run_dir: Path, step: int) -> Path:
    """Write a checkpoint, keep the newest two, and let ``last`` point to it.

    Returns:
        The checkpoint's directory.
    """
    folder = run_dir / FOLDER
    folder.mkdir(exist_ok=True)
    directory = folder / f"step_{step:010d}"
    checkpoint.save(snapshot, directory, step=step)
    fault_point("checkpoint.before_link")
    point_to(folder / LAST, directory)
    fault_point("checkpoint.before_forgetting")
    _forget(run_dir, older_than=directory)
    return directory


def newest_checkpoint(run_dir: Path) -> Path | None:
    """Return the newest checkpoint that is whole; None: there is none."""
    for directory in _generations(run_dir):
        with contextlib.suppress(CheckpointError):
            checkpoint.verify(directory)
            return directory
    return None


def load_latest(run_dir: Path) -> tuple[Snapshot, int]:
    """Load the newest checkpoint that is whole, and its step.

    What a killed process left unfinished is removed, and so are the generations that it had no
    time to forget.

    Raises:
        CheckpointError: If there is none.
    """
    for folder in (run_dir, run_dir / FOLDER):
        remove_unfinished(folder)
    damaged = []
    for directory in _generations(run_dir):
        try:
            snapshot, manifest = checkpoint.load(directory), checkpoint.verify(directory)
        except CheckpointError as error:
            damaged.append(str(error))
            continue
        if damaged:
            _log.warning("%s Using the older %s.", " ".join(damaged), directory.name)
        _tell_other_versions(manifest)
        _forget(run_dir, older_than=directory)
        return snapshot, manifest["step"]
    raise CheckpointError(
        " ".join(damaged)
        or f"'{run_dir}' has no checkpoint. Runs keep one with save_model_freq=N, and when "
        "they are stopped with Ctrl-C."
    )


def _tell_other_versions(manifest: Mapping[str, Any]) -> None:
    """Say when a package is not the one that wrote the checkpoint: numbers may differ then."""
    saved, here = manifest.get("versions", {}), checkpoint.versions()
    changed = [
        f"{name} {saved[name]} -> {here[name]}"
        for name in here
        if name in saved and saved[name] != here[name]
    ]
    if changed:
        _log.warning(
            "The checkpoint was written with other versions (%s), so the rest of the run is not "
            "bit for bit what it would have been.",
            ", ".join(changed),
        )


def _generations(run_dir: Path) -> list[Path]:
    """Return the checkpoints, newest first."""
    return sorted((run_dir / FOLDER).glob("step_*[0-9]"), reverse=True)


def _forget(run_dir: Path, *, older_than: Path) -> None:
    """Remove all but the newest generations, and never one that is needed or newer than that."""
    for old in _generations(run_dir)[GENERATIONS:]:
        if old.name < older_than.name:
            discard(old)


def _replay_episodes(env: ObservedVecEnv, episodes: list[Any], observed: dict[str, Any]) -> bool:
    """Bring each environment to its place; False when one does not repeat itself exactly."""
    repeated = [
        env.env_method("replay_episode", episode, indices=index)[0]
        for index, episode in enumerate(episodes)
    ]
    expected = observed["observations"]
    if not episodes:  # one of them had failed when the checkpoint was made
        return False
    for index, observation in enumerate(repeated):
        if not _equal(observation, single(expected, index)):
            _log.warning(
                "%s does not repeat an episode exactly; a new one is begun, so the rest of the run "
                "differs from the uninterrupted one.",
                env.name,
            )
            return False
    env.continue_from(observed)
    return True


class _UndoPreparations(BaseCallback):
    """Undoes how ``learn`` prepares noise for its first rollout.

    Action noise is reset there, and that of gSDE (arXiv 2005.05719) is drawn, which the state has
    behind it.
    """

    def __init__(self, model: Algorithm, random: RandomState) -> None:
        super().__init__()
        self._random: RandomState | None = random
        noise = getattr(model, "action_noise", None)
        policy = getattr(model, "actor", None) or getattr(model, "policy", None)
        prepared = [*getattr(noise, "noises", [noise]), getattr(policy, "action_dist", None)]
        # What they draw replaces what they had, and does not change it: references are enough.
        self._states = [(part, dict(vars(part))) for part in prepared if hasattr(part, "__dict__")]

    def _on_rollout_start(self) -> None:
        if self._random is not None:
            for part, state in self._states:  # in place: `learn` has handed them on already
                vars(part).update(state)
            set_random_state(self._random)
            self._random = None

    def _on_step(self) -> bool:
        return True


def _begin_new_episodes(model: Any) -> None:
    env = model.get_env()
    model._last_obs = env.reset()
    if hasattr(model, "_last_episode_starts"):
        model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
    truncate = getattr(getattr(model, "replay_buffer", None), "truncate_last_trajectory", None)
    if truncate is not None:
        truncate()


def _equal(one: Observation, other: Observation) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return set(one) == set(other) and all(_equal(one[key], other[key]) for key in one)
    # A vector environment stores observations in the type of the space.
    other = np.asarray(other)
    return bool(np.array_equal(np.asarray(one).astype(other.dtype), other))
