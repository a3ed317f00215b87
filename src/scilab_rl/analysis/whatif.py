"""Counterfactual futures of a recorded episode: what else could have happened from a scene on.

The environment is put back into a scene, something is changed, and the policy acts until the end,
several times with different noise. From every scene, the share of futures that succeed says when
the episode was decided.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from gymnasium import spaces

from scilab_rl.analysis.estimates import Estimate, success_interval
from scilab_rl.envs.goal import goal_distance
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.scenes import EpisodeScenes, change_goal, start_from_text
from scilab_rl.envs.types import Observation
from scilab_rl.errors import ConfigError
from scilab_rl.learning.inspector import LOG_PROB, VALUE, AgentInspector
from scilab_rl.machine import n_cores
from scilab_rl.metrics.success import success_of
from scilab_rl.recording.records import Clip
from scilab_rl.seeding import derive_seed

SIGMA = 0.1  # noise of a policy that has none of its own
_LONGEST = 10_000  # steps of a future in a task without step limit


@dataclass(frozen=True)
class Change:
    """What differs from the recorded episode.

    Attributes:
        goal: Another desired goal; None: the episode's. Shapes: ``(*goal_shape)``.
        action: What is done first, instead of what the policy wants; None: nothing else.
        n_actions: For how many steps.
        sigma: Standard deviation of Gaussian noise that is added to the actions, where 1 is half of
            their range; for discrete actions the probability of a random one. None: `SIGMA` where
            the policy has no noise of its own, and 0 elsewhere.
        seed: Of all noise.
    """

    goal: np.ndarray | None = None
    action: np.ndarray | None = None
    n_actions: int = 1
    sigma: float | None = None
    seed: int = 0


@dataclass
class Future:
    """What followed from a scene on.

    Attributes:
        scene: Number of the scene.
        achieved: Achieved goal in each scene from there on; empty without goals.
        distances: Distance to the goal in these scenes.
        values: Value of these scenes, as the policy's critics see them.
        rewards: Of each step.
        success: Whether it ended in success; None: the task did not say.
    """

    scene: int
    achieved: list[np.ndarray] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    success: bool | None = None


@dataclass(frozen=True)
class SceneRate:
    """How often the futures of a scene succeed, with the exact 95 % interval."""

    scene: int
    n_successes: int
    n: int

    @property
    def estimate(self) -> Estimate:
        """The share with its interval."""
        return success_interval(self.n_successes, self.n, "exact")


@dataclass(frozen=True)
class Decision:
    """When an episode was decided.

    Attributes:
        rates: Of each scene that was asked about, in order.
        succeeded: How the episode ended.
        scene: The first scene from which on all futures end as the episode did: after a failure
            the point of no return. The last action that mattered is the one before it.
    """

    rates: list[SceneRate]
    succeeded: bool
    scene: int

    @property
    def largest_change(self) -> tuple[SceneRate, SceneRate] | None:
        """The two neighboring scenes between which the share of successes changes most."""
        pairs = list(zip(self.rates, self.rates[1:], strict=False))
        return max(pairs, key=_change_of, default=None)


class FuturePlayer:
    """Plays futures of one recorded episode, many at once.

    Args:
        inspector: The policy that acts.
        envs: Environments of the task, of `make_copies`; at least two.
        clip: The recorded episode.

    Attributes:
        scenes: Its scenes.

    Raises:
        ConfigError: If the recording is not that of one whole episode, or cannot be repeated.
    """

    def __init__(self, inspector: AgentInspector, envs: Sequence[RunEnv], clip: Clip) -> None:
        self.inspector, self.envs = inspector, list(envs)
        records = clip.records
        if not records[0].start or records[0].step or any(r.step == 0 for r in records[1:]):
            raise ConfigError(
                f"The recording {clip.info.name} cannot be taken up again: it must be of one whole "
                "episode, and of this version. `scilab-rl whatif RUN --seed 1` records one."
            )
        actions = [record.action for record in records if record.action is not None]
        observed = [record.observation for record in records]
        for env in self.envs:
            env.reset(seed=0)
        start = start_from_text(records[0].start)
        self.scenes = EpisodeScenes(self.envs[0], start, actions, observed[: len(actions) + 1])
        self.scenes.check_snapshots(self.envs[1], sorted({0, len(actions) // 2}))
        self._rng = np.random.default_rng()

    def play(
        self, scenes: Sequence[int], change: Change, *, deterministic: bool = False
    ) -> list[Future]:
        """Return a future for each scene of a list, which may name a scene several times.

        Args:
            scenes: Numbers of scenes that have a step after them.
            change: What differs.
            deterministic: Whether the policy takes its most likely actions, without any noise.
        """
        import torch

        change = replace(change, action=self._checked(change.action))
        seed = derive_seed(change.seed, "whatif")
        self._rng = np.random.default_rng(seed)
        with self.inspector.undisturbed():
            np.random.seed(seed)
            torch.manual_seed(seed)
            with ThreadPoolExecutor(min(n_cores(), len(self.envs))) as threads:
                return self._play(scenes, change, deterministic, threads)

    def _checked(self, action: np.ndarray | None) -> np.ndarray | None:
        """Return an action in the environment's own type.

        Raises:
            ConfigError: If it is not one of its actions.
        """
        space = self.envs[0].action_space
        if action is None:
            return None
        shape, size = space.shape or (), int(np.prod(space.shape or ()))
        converted = np.asarray(action).astype(space.dtype).reshape(-1)
        if len(converted) != size or not space.contains(converted.reshape(shape)[()]):
            raise ConfigError(f"An action must be one of {space}, but it is {np.asarray(action)}.")
        return converted.reshape(shape)

    def _play(
        self,
        scenes: Sequence[int],
        change: Change,
        deterministic: bool,
        threads: ThreadPoolExecutor,
    ) -> list[Future]:
        futures = [Future(scene) for scene in scenes]
        waiting, running = deque(futures), dict[int, Future]()
        observations: dict[int, Observation] = {}
        while waiting or running:
            for row in range(len(self.envs)):
                if row not in running and waiting:
                    running[row] = waiting.popleft()
                    observations[row] = self._begin(row, running[row], change)
            rows = list(running)
            seen = self._batch([observations[row] for row in rows])
            self._note_values(seen, list(running.values()))
            actions = self._actions(seen, list(running.values()), change, deterministic)
            steps = _in_parallel(threads, self.envs, rows, actions)
            for row, (observation, reward, is_last, info) in zip(rows, steps, strict=True):
                observations[row] = observation
                if _note_step(running[row], observation, reward, is_last, info):
                    self._note_last_value(running.pop(row), observation)
        return futures

    def _begin(self, row: int, future: Future, change: Change) -> Observation:
        env = self.envs[row]
        observation = self.scenes.put(env, future.scene)
        env.reseed(int(self._rng.integers(2**31)))  # chance of the task, if there is any
        if change.goal is not None:
            observation = change_goal(env, observation, change.goal)
        _note_goal(future, observation)
        return observation

    def _actions(
        self, seen: Observation, futures: Sequence[Future], change: Change, deterministic: bool
    ) -> np.ndarray:
        actions = self.inspector.act(seen, deterministic=deterministic)
        if not deterministic:
            actions = self._noisy(actions, self.sigma_of(change))
        if change.action is not None:
            for index, future in enumerate(futures):
                if len(future.rewards) < change.n_actions:
                    actions[index] = change.action
        return actions

    def sigma_of(self, change: Change) -> float:
        """Return the standard deviation of the noise that is added to actions."""
        if change.sigma is not None:
            return change.sigma
        return 0.0 if LOG_PROB in self.inspector.quantities else SIGMA

    def _noisy(self, actions: np.ndarray, sigma: float) -> np.ndarray:
        space, n = self.envs[0].action_space, len(actions)
        if not sigma:
            return actions
        if isinstance(space, spaces.Box):
            noise = self._rng.standard_normal(actions.shape) * sigma * (space.high - space.low) / 2
            return np.clip(actions + noise, space.low, space.high).astype(space.dtype)
        space.seed(int(self._rng.integers(2**31)))
        random = np.array([space.sample() for _ in range(n)]).reshape(actions.shape)
        chosen = self._rng.random(n) < sigma
        return np.where(chosen.reshape(n, *[1] * (actions.ndim - 1)), random, actions)

    def _batch(self, observations: Sequence[Observation]) -> Observation:
        space = self.envs[0].observation_space
        if isinstance(space, spaces.Dict):
            return {
                key: np.stack([o[key] for o in observations]).astype(space[key].dtype)
                for key in space.spaces
            }
        return np.stack([np.asarray(o) for o in observations]).astype(space.dtype)

    def _note_values(self, seen: Observation, futures: Sequence[Future]) -> None:
        if VALUE in self.inspector.quantities:
            for future, value in zip(futures, self.inspector.values(seen), strict=True):
                future.values.append(float(value))

    def _note_last_value(self, future: Future, observation: Observation) -> None:
        self._note_values(self._batch([observation]), [future])

    def happened(self, clip: Clip) -> Future:
        """Return the recorded episode as a future of its first scene."""
        future = Future(0)
        for record in clip.records:
            _note_goal(future, record.observation)
            if record.reward is not None:
                future.rewards.append(record.reward)
                future.success = record.success
        batch = self._batch([record.observation for record in clip.records])
        if VALUE in self.inspector.quantities:
            future.values = self.inspector.values(batch).tolist()
        return future


def rates_of(futures: Sequence[Future]) -> list[SceneRate]:
    """Return how often the futures of each scene succeed, in the order of scenes."""
    scenes = sorted({future.scene for future in futures})
    outcomes = [[bool(f.success) for f in futures if f.scene == scene] for scene in scenes]
    return [
        SceneRate(scene, sum(outcome), len(outcome))
        for scene, outcome in zip(scenes, outcomes, strict=True)
    ]


def decision(rates: Sequence[SceneRate], n_steps: int, *, succeeded: bool) -> Decision:
    """Return when an episode was decided.

    Args:
        rates: Of scenes, in order.
        n_steps: Of the episode; its last scene has this number, and its outcome is known.
        succeeded: How the episode ended.
    """
    scene = n_steps
    for rate in reversed(rates):
        if rate.n_successes != (rate.n if succeeded else 0):
            break
        scene = rate.scene
    return Decision(list(rates), succeeded, scene)


def find_decision(
    player: FuturePlayer,
    clip: Clip,
    change: Change,
    *,
    n_futures: int,
    every: int = 1,
) -> tuple[list[Future], Decision]:
    """Play futures of the scenes of an episode, and find the one from which on it was decided.

    Args:
        player: Of the episode.
        clip: The episode.
        change: What differs.
        n_futures: Of each scene.
        every: Steps between the scenes; those around the decision are then all asked about.

    Raises:
        ConfigError: If the task does not report success.
    """
    outcome = next((r.success for r in reversed(clip.records) if r.success is not None), None)
    if outcome is None:
        raise ConfigError(
            f"{clip.info.env_id} does not report success (info['is_success']), so that nothing "
            "says when an episode was decided; --at T shows the futures of one scene."
        )
    n_steps = len(player.scenes) - 1
    scenes = list(range(0, n_steps, every))
    futures = _play_scenes(player, scenes, change, n_futures)
    found = decision(rates_of(futures), n_steps, succeeded=outcome)
    between = [s for s in range(max(0, found.scene - every + 1), found.scene) if s not in scenes]
    futures += _play_scenes(player, between, change, n_futures)
    return futures, decision(rates_of(futures), n_steps, succeeded=outcome)


def _play_scenes(
    player: FuturePlayer, scenes: Sequence[int], change: Change, n_futures: int
) -> list[Future]:
    return player.play([scene for scene in scenes for _ in range(n_futures)], change)


def _in_parallel(
    threads: ThreadPoolExecutor, envs: Sequence[RunEnv], rows: Sequence[int], actions: np.ndarray
) -> list[tuple[Observation, float, bool, dict[str, object]]]:
    """Step some environments; MuJoCo computes without Python's lock."""

    def step_share(
        share: np.ndarray,
    ) -> list[tuple[Observation, float, bool, dict[str, object]]]:
        results = []
        for index in share:
            observation, reward, terminated, truncated, info = envs[rows[index]].step(
                actions[index]
            )
            results.append((observation, float(reward), bool(terminated or truncated), info))
        return results

    n = threads._max_workers
    shares = np.array_split(np.arange(len(rows)), n)
    return [result for share in threads.map(step_share, shares) for result in share]


def _note_goal(future: Future, observation: Observation) -> None:
    if isinstance(observation, dict) and "desired_goal" in observation:
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        future.achieved.append(np.array(achieved))
        future.distances.append(float(goal_distance(achieved, desired)))


def _note_step(
    future: Future, observation: Observation, reward: float, is_last: bool, info: dict[str, object]
) -> bool:
    """Add a step to a future; return whether it was the last one."""
    future.rewards.append(reward)
    future.success = success_of(info)
    _note_goal(future, observation)
    return is_last or len(future.rewards) >= _LONGEST


def _change_of(pair: tuple[SceneRate, SceneRate]) -> float:
    before, after = pair
    return abs(before.n_successes / before.n - after.n_successes / after.n)
