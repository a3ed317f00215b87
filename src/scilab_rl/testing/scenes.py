"""The contract of scenes: an environment that is put back into one continues as before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from scilab_rl.envs.random_rollout import scripted_action
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.scenes import EpisodeScenes, start_as_text, start_from_text
from scilab_rl.envs.types import StepResult
from scilab_rl.envs.wrapper_memory import memory_of, owned

N_STEPS = 20


def assert_scenes_are_restored(make: Callable[[], RunEnv], n_before: int = 8) -> None:
    """Check that another instance, put back into a scene, repeats 20 steps to the last bit.

    That holds for observations with their goals, rewards, both flags and infos, the count of steps
    and what wrappers remember; for snapshots, where there are any, and for replayed episodes.

    Args:
        make: Makes the environment.
        n_before: Steps before the scene.

    Raises:
        AssertionError: If anything differs.
    """
    first, other = make(), make()
    try:
        first.reset(seed=5)
        first.reset()  # the second episode of a generator
        rng = np.random.default_rng(6)
        actions = [scripted_action(first.action_space, rng) for _ in range(n_before + N_STEPS)]
        course = _course(first, actions)
        start = start_from_text(start_as_text(first.episode_start()))
        expected, ended = course[n_before:], _progress(first)
        other.reset(seed=7)
        _course(other, actions[::-1][:5])
        scenes = EpisodeScenes(first, start, actions[: len(course)])
        scene = len(course) - len(expected)
        assert scenes.check_snapshots(other, [0, scene]) == scenes.is_fast
        for is_fast in {scenes.is_fast, False}:
            scenes.is_fast = is_fast
            scenes.put(other, scene)
            np.testing.assert_equal(_course(other, actions[scene : len(course)]), expected)
            np.testing.assert_equal(_progress(other), ended)
    finally:
        first.close()
        other.close()


def _course(env: RunEnv, actions: Sequence[np.ndarray]) -> list[StepResult]:
    """Take steps until the episode ends; return all that they returned."""
    results: list[StepResult] = []
    for action in actions:
        results.append(owned(env.step(action)))
        if results[-1][2] or results[-1][3]:
            break
    return results


def _progress(env: RunEnv) -> dict[str, Any]:
    """Return the count of steps, what wrappers remember, and what began the episode."""
    counted = env.has_wrapper_attr("_elapsed_steps")
    steps = env.get_wrapper_attr("_elapsed_steps") if counted else None
    return {"steps": steps, "memory": memory_of(env.env), "episode": env.episode_state()}
