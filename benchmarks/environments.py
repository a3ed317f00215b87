"""Time per step and reset of our environments beside the original packages', and bit-identity.

Blocks of steps of ours and of the original alternate, so that both see the same machine; the median
of the blocks counts, in processor time. Ours come with all wrappers of a run, the originals bare.
"identical" compares observations, rewards and endings to the last bit over all steps, from the same
seeds; "-" where ours is a different task, compared with the most similar one.

Run: python benchmarks/environments.py [--steps N] [--json FILE]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.checker import equal
from scilab_rl.envs.fingerprint import scripted_action
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.envs.vectorize import make_single_env

BLOCK = 50
COLUMNS = (
    "env", "original", "step ms", "original step ms", "ratio", "reset ms", "original reset ms",
    "identical",
)  # fmt: skip
Make = Callable[[], gym.Env]


@dataclass
class Pair:
    """An environment of ours and what it is compared with.

    Attributes:
        env_id: Ours.
        original: What the other is called.
        make_original: Makes the other.
        same_task: Whether both have to be the same task.
        package: The package that both need.
    """

    env_id: str
    original: str
    make_original: Make
    same_task: bool = False
    package: str = "gymnasium_robotics"


def registered(env_id: str, **arguments: Any) -> gym.Env:
    """Make an environment of another package, without any of our wrappers."""
    return gym.make(resolve_env_id(env_id)[0], **arguments).unwrapped


class Seeded(gym.Wrapper):
    """Passes the seed of a reset on, which Meta-World ignores."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode."""
        self.env.unwrapped.np_random = np_random(seed)[0]
        return self.env.reset()


def original_metaworld(task: str) -> gym.Env:
    """Make a task of Meta-World as its own benchmarks do, with goals that are drawn and seen."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    env: Any = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    env._partially_observable = False
    env.__dict__.pop("sawyer_observation_space", None)
    return Seeded(env)


def original_panda(env_id: str) -> gym.Env:
    """Make a task of panda-gym from its own class."""
    from panda_gym.envs import panda_tasks

    return getattr(panda_tasks, f"{env_id.removesuffix('-v3')}Env")()


def same(env_id: str, make_original: Make, package: str) -> Pair:
    """Compare a task as we make it with the same task as its package makes it."""
    return Pair(env_id, "the same", make_original, same_task=True, package=package)


def fetch(env_id: str) -> Pair:
    """Compare Fetch as we make it with Fetch as it is."""
    return same(env_id, partial(registered, env_id), "gymnasium_robotics")


def own_arm(env_id: str, relative: str) -> Pair:
    """Compare a task of our own with its nearest relative among Fetch's."""
    return Pair(env_id, relative, partial(registered, relative))


_ROOM = [[1] * 5, [1, 0, 0, 0, 1], [1, 0, 0, 0, 1], [1, 0, 0, 0, 1], [1] * 5]
PAIRS = [
    *map(fetch, ("FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4", "FetchSlide-v4")),
    own_arm("Reach1DOF-v0", "FetchReach-v4"),
    own_arm("Blocks-o0-gripper_random-v1", "FetchReach-v4"),
    own_arm("Blocks-o1-gripper_none-v1", "FetchPush-v4"),
    own_arm("Blocks-o4-gripper_random-v1", "FetchPush-v4"),
    own_arm("Hook-o2-v1", "FetchPush-v4"),
    own_arm("ButtonUnlock-o2-v1", "FetchPush-v4"),
    Pair(
        "PointGym-sparse-0.5-small_open_dgr-c1-rt0-s500-v0",
        "PointMaze_Open-v3",
        partial(registered, "PointMaze_Open-v3", maze_map=_ROOM),
    ),
    Pair(
        "PointObjGym-sparse-o4-0.5-small_open_dgr-c1-rt0-s300-v0",
        "PointMaze_Open-v3",
        partial(registered, "PointMaze_Open-v3", maze_map=_ROOM),
    ),
    Pair(
        "AntGym-sparse-5-0.5-small_open_dgr-c1-rt0-s500-v0",
        "AntMaze_Open-v5",
        partial(registered, "AntMaze_Open-v5", maze_map=_ROOM),
    ),
    same("parking-limited-v0", partial(registered, "parking-v0"), "highway_env"),
    *(
        same(f"MetaW-{task}-v3", partial(original_metaworld, task), "metaworld")
        for task in ("reach", "drawer-close", "pick-place")
    ),
    same("PandaPush-v3", partial(original_panda, "PandaPush-v3"), "panda_gym"),
]


class Course:
    """Steps of one environment in blocks, timed, with scripted actions and seeded resets.

    Args:
        env: The environment; step limits other than the course's are taken off.
        episode: Steps after which it is reset.
    """

    def __init__(self, env: gym.Env, episode: int) -> None:
        self.env = env
        self.episode = episode
        self.rng = np.random.default_rng(0)
        self.n_episodes = self.n_steps = 0
        self.steps: list[float] = []
        self.resets: list[float] = []

    def block(self) -> list[Any]:
        """Take a block of steps and return all that came back."""
        seen: list[Any] = []
        spent = 0.0
        for _ in range(BLOCK):
            if self.n_steps % self.episode == 0:
                seen.append(self._reset())
            action = scripted_action(self.env.action_space, self.rng)
            begin = time.thread_time()
            result = self.env.step(action)
            spent += time.thread_time() - begin
            seen.append(result[:3])
            self.n_steps += 1
            if result[2]:  # the end of an episode; both have to see it
                self.n_steps += -self.n_steps % self.episode
        self.steps.append(spent / BLOCK)
        return seen

    def _reset(self) -> Any:
        begin = time.thread_time()
        observation, _ = self.env.reset(seed=self.n_episodes)
        self.resets.append(time.thread_time() - begin)
        self.n_episodes += 1
        return observation


def measure(pair: Pair, n_steps: int) -> dict[str, Any]:
    """Return the row of one pair; times in ms."""
    resolve_env_id(pair.env_id)
    limit = min(gym.spec(pair.env_id).max_episode_steps or BLOCK, BLOCK)  # for many resets
    ours = Course(make_single_env(RunConfig(pair.env_id)), limit)
    other = Course(pair.make_original(), limit)
    identical = True
    for _ in range(-(-n_steps // BLOCK)):
        identical &= equal(ours.block(), other.block())
    step, original = (1e3 * statistics.median(course.steps) for course in (ours, other))
    row = {
        "env": pair.env_id,
        "original": pair.original,
        "step ms": step,
        "original step ms": original,
        "ratio": step / original,
        "reset ms": 1e3 * statistics.median(ours.resets),
        "original reset ms": 1e3 * statistics.median(other.resets),
        "identical": identical if pair.same_task else None,
        "steps": ours.n_steps,
    }
    for course in (ours, other):
        course.env.close()
    return row


def as_line(row: dict[str, Any]) -> str:
    """Return a row as a line of a Markdown table."""
    words = {None: "-", True: "yes", False: "no"}
    cells = (row[column] for column in COLUMNS)
    texts = (f"{c:.2f}" if isinstance(c, float) else words.get(c, c) for c in cells)
    return f"| {' | '.join(map(str, texts))} |"


def main() -> None:
    """Print the table while it is measured, and all as JSON at the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000, help="for each (default 1000)")
    parser.add_argument("--json", type=Path, help="also write the JSON to this file")
    options = parser.parse_args()
    sys.stdout.write(f"| {' | '.join(COLUMNS)} |\n|{' --- |' * len(COLUMNS)}\n")
    rows = []
    for pair in PAIRS:
        if importlib.util.find_spec(pair.package):
            rows.append(measure(pair, options.steps))
            sys.stdout.write(as_line(rows[-1]) + "\n")
            sys.stdout.flush()
    text = json.dumps(rows) + "\n"
    sys.stdout.write(text)
    if options.json:
        options.json.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
