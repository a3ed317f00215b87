"""A short hash that changes when an environment's behavior changes under the same name."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

KNOWN = Path(__file__).parent / "assets" / "fingerprints.json"
SEED = 1234
N_STEPS = 20
DECIMALS = 5


def fingerprint(env: gym.Env) -> str:
    """Return the fingerprint: the first observation of a fixed seed and 20 scripted steps.

    Observations and rewards are rounded to 5 decimals, so that another processor's last bits do
    not count. The environment is left in an arbitrary state.

    Args:
        env: Any environment; its wrappers count too, except the step limit.
    """
    digest = hashlib.sha256()
    rng = np.random.default_rng(SEED)
    observation, _ = env.reset(seed=SEED)
    _update(digest, observation)
    for _ in range(N_STEPS):
        observation, reward, terminated, _, _ = env.step(scripted_action(env.action_space, rng))
        _update(digest, observation)
        _update(digest, float(reward))
        if terminated:
            break
    return digest.hexdigest()[:16]


def known(env_id: str) -> tuple[str, ...]:
    """Return the fingerprints that an environment has with the pinned versions, if we know any.

    Args:
        env_id: An id with its version.
    """
    recorded = json.loads(KNOWN.read_text(encoding="utf-8"))
    return tuple(recorded.get(env_id, ()))


def scripted_action(space: gym.Space, rng: np.random.Generator) -> Any:
    """Return an action that depends on the generator alone, not on Gymnasium's sampling."""
    if isinstance(space, gym.spaces.Box):
        low = np.where(np.isfinite(space.low), space.low, -1.0)
        high = np.where(np.isfinite(space.high), space.high, 1.0)
        return rng.uniform(low, high).astype(space.dtype)
    if isinstance(space, gym.spaces.Discrete):
        return int(space.start + rng.integers(space.n))
    if isinstance(space, gym.spaces.MultiDiscrete):
        return rng.integers(space.nvec)
    if isinstance(space, gym.spaces.MultiBinary):
        return rng.integers(0, 2, size=space.shape).astype(space.dtype)
    space.seed(int(rng.integers(2**31)))
    return space.sample()


def _update(digest: hashlib._Hash, value: object) -> None:
    if isinstance(value, dict):
        for key in sorted(value):
            digest.update(str(key).encode())
            _update(digest, value[key])
    elif isinstance(value, tuple):
        for entry in value:
            _update(digest, entry)
    else:
        # adding 0.0 turns -0.0 into 0.0
        digest.update((np.round(np.asarray(value, dtype=np.float64), DECIMALS) + 0.0).tobytes())
