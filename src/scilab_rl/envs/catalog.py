"""Descriptions of the environments and of the packages that they come from."""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium as gym
from gymnasium import spaces

from scilab_rl.envs.registration import known_env_ids, module_of, suite_of, versions_by_family
from scilab_rl.envs.suites import SUITES

# What environments are like with the pinned versions, for a list that makes none of them.
SPACES = Path(__file__).parent / "assets" / "spaces.json"
DETAILS = ("observation", "action", "goal", "steps", "problem")


def list_suites() -> list[dict[str, object]]:
    """Return the packages with environments: installed or not, how to install, known problems."""
    return [
        {
            "suite": suite.package,
            "installed": suite.installed,
            "contents": suite.contents,
            "install": suite.install_line or None,
            "conflicts": suite.conflicts or None,
            "note": suite.note or None,
        }
        for suite in SUITES
    ]


def list_all() -> list[dict[str, object]]:
    """Return the newest usable version of each environment, without making any.

    Returns:
        For each its id, step limit (None: no limit), package, older usable ids, and, as recorded
        with the pinned versions, its spaces and whether it has goals.
    """
    unknown = dict.fromkeys(("observation", "action", "goal"))
    rows, recorded = [], recorded_spaces()
    for versions in versions_by_family(known_env_ids()).values():
        spec = gym.registry[versions[-1]]
        suite = suite_of(spec)
        name = suite.package if suite else module_of(spec).partition(".")[0]
        row = {"env": spec.id, "steps": spec.max_episode_steps, **recorded.get(spec.id, unknown)}
        rows.append(row | {"suite": name, "older": versions[:-1]})
    return rows


def recorded_spaces() -> dict[str, dict[str, object]]:
    """Return by id what `describe` said of ``observation``, ``action`` and ``goal``."""
    return json.loads(SPACES.read_text(encoding="utf-8"))


def describe(env_id: str) -> dict[str, object]:
    """Make an environment and return its spaces, step limit, and whether it has goals."""
    row: dict[str, object] = {"env": env_id} | dict.fromkeys(DETAILS)
    try:
        env = gym.make(env_id)
    except Exception as error:  # noqa: BLE001 - listed with the reason
        return row | {"problem": f"{type(error).__name__}: {error}"}
    space = env.observation_space
    row |= {
        "observation": space_text(space),
        "action": space_text(env.action_space),
        "goal": isinstance(space, spaces.Dict)
        and {"achieved_goal", "desired_goal"} <= {*space.keys()},
        "steps": env.spec.max_episode_steps if env.spec else None,
    }
    env.close()
    return row


def space_text(space: spaces.Space) -> str:
    """Return a short description of a space.

    >>> from gymnasium.spaces import Box, Dict
    >>> space_text(Dict(goal=Box(-1, 1, (3,)), observation=Box(-float("inf"), float("inf"), (10,))))
    'goal: Box(3) from -1 to 1, observation: Box(10)'
    """
    if isinstance(space, spaces.Dict):
        return ", ".join(f"{key}: {space_text(entry)}" for key, entry in space.spaces.items())
    if not isinstance(space, spaces.Box):
        return str(space)
    has_bounds = space.is_bounded() and space.low.size > 0
    bounds = f" from {space.low.min():g} to {space.high.max():g}" if has_bounds else ""
    return f"Box({', '.join(map(str, space.shape))}){bounds}"
