"""Hindsight experience replay over whole episodes: small, and fast to sample from.

Andrychowicz et al., 2017, "Hindsight Experience Replay", arXiv 1707.01495: a transition is learned
from not only with the goal that was wanted, but also with one that was reached. This buffer can
take the place of Stable-Baselines3's ``HerReplayBuffer``, from which it differs in this:

* Observations are rows of float32, and an episode of T steps takes T + 1 rows: what follows a step
  is the next row, and is not stored twice. FetchPush takes 156 bytes per step, a quarter.
* A relabeled transition gets the reward *and* the ending of its new goal.
* Each transition is relabeled with probability k / (k + 1), in one vectorized call for any number
  of batches, and the chance comes from a generator of its own.
* Goals may also be drawn from all episodes (``random``), and may change within an episode.
* Goals may also be the desired goals of other episodes (``desired_share``), which keeps what is
  learned near what is asked for (Pitis et al., 2020, arXiv 2007.02832).
* Goals may be drawn from the discounted future (``geometric``), and without rewards
  (``goals_only``), as contrastive algorithms need them; see `jaxcrl`.
* With a `relay`, half of each batch is of a goal that comes before the task's.
* A share of each batch may come from demonstrations, a ring of their own that nothing overwrites;
  they are relabeled like all others (Nair et al., 2018, arXiv 1709.10089, section IV).
* Episodes in which the achieved goal moved may be preferred (``moved_share``): where an object lies
  still, every goal of the episode is the same, and there is nothing to learn about pushing it. That
  is the coarsest form of Zhao and Tresp, 2018, "Energy-Based Hindsight Experience Prioritization",
  arXiv 1810.01363.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from scilab_rl.envs.vec_step import Info, decode_dones
from scilab_rl.errors import ConfigError, EnvironmentFailure, did_you_mean, listing
from scilab_rl.learning.goal_functions import goal_reward, goal_termination
from scilab_rl.learning.relay import Relay
from scilab_rl.relabeling import INFO_KEYS

GOAL_STRATEGIES = ("future", "geometric", "final", "episode", "random")
# An achieved goal that stays within this range in every dimension has not moved (metres).
_REST = 0.01
# Rows of `HindsightReplayBuffer._cursors`.
_OLDEST, _START, _NOW = range(3)
_MIN_ROWS = 4


V = TypeVar("V", np.ndarray, torch.Tensor)


class Transitions(NamedTuple):
    """A batch of transitions as arrays, observations as one vector each.

    Attributes:
        observations: The entries of the dictionary, joined in the order of the space.
            Shapes: ``(batch, n_observations)``.
        actions: Shapes: ``(batch, n_actions)``.
        next_observations: With the same goal, when it was relabeled. Shapes: as observations.
        rewards: Shapes: ``(batch,)``.
        terminated: 1 where the next state is terminal and has no future; 0 also where an episode
            was only cut off. Shapes: ``(batch,)``.
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray


def can_hold(space: spaces.Space) -> bool:
    """Return whether observations are dictionaries of floating-point arrays with goals."""
    return (
        isinstance(space, spaces.Dict)
        and {"observation", "achieved_goal", "desired_goal"} <= set(space.spaces)
        and all(
            isinstance(entry, spaces.Box) and np.issubdtype(entry.dtype, np.floating)
            for entry in space.spaces.values()
        )
    )


class HindsightReplayBuffer(HerReplayBuffer):
    """A ring of whole episodes per environment, relabeled when sampled.

    Only episodes that have ended are sampled. When the ring is full, the oldest episode makes room
    as a whole.

    Args:
        buffer_size: Rows over all environments; an episode of T steps takes T + 1 of them.
        observation_space: A `can_hold` one.
        action_space: Of one environment.
        env: Whose ``compute_reward`` and, if it has one, ``compute_terminated`` judge new goals.
        device: Where `sample` puts its tensors.
        n_envs: Number of environments.
        optimize_memory_usage: For Stable-Baselines3; the memory is small in either case.
        n_sampled_goal: Relabeled transitions per original one, k in the paper.
        goal_selection_strategy: Which goals are put in: ``future``, one that is reached from this
            step on in the same episode; ``geometric``, the one that is reached k steps later, with
            a probability in proportion to discount^(k - 1); ``final``, the one reached at its end;
            ``episode``, any of it; ``random``, any of all episodes. In the paper ``future`` does
            best, with k = 4 or 8.
        moved_share: Share of transitions that are drawn only from episodes in which the achieved
            goal moved, once there are any; the others are drawn from all.
        desired_share: Share of relabeled transitions whose goal is the desired goal of a step that
            is drawn from all episodes, instead of one that was reached.
        discount: How soon ``geometric`` goals are reached, between 0 and 1.
        goals_only: Whether every transition is relabeled, with reward 0 and no ending: for
            algorithms that learn from goals alone. The environment needs no ``compute_reward``.
        relay: The two goals of relay hindsight, see `Relay`; samples then end with its flag.
        info_keys: Numbers in the infos of steps that reward or ending depend on besides the goals.
        seed: Of the generator; None: drawn from NumPy's global one, which the run has seeded.

    Attributes:
        rows: Observations as vectors. Shapes: ``(n_rows, n_envs, n_observations)``.
        demos: Demonstrations, see `use_demos`; None: none.
        demo_share: Their share of each batch.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        env: VecEnv,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        n_sampled_goal: int = 4,
        goal_selection_strategy: str = "future",
        moved_share: float = 0.0,
        desired_share: float = 0.0,
        discount: float = 0.99,
        goals_only: bool = False,
        relay: Relay | None = None,
        info_keys: Sequence[str] = (),
        seed: int | None = None,
    ) -> None:
        # What Stable-Baselines3's own classes allocate is not wanted.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        _check(observation_space, n_sampled_goal, goal_selection_strategy)
        _check_shares(moved_share=moved_share, desired_share=desired_share)
        if goal_selection_strategy == "geometric" and not 0 < discount < 1:
            raise ConfigError(
                "Geometric goals need a discount (gamma) above 0 and below 1, but it is "
                f"{discount}."
            )
        n_rows = max(buffer_size // n_envs, _MIN_ROWS)
        self.buffer_size = n_rows
        self.env = env
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = True
        self.n_sampled_goal = n_sampled_goal
        self.strategy = goal_selection_strategy
        self.moved_share = moved_share
        self.desired_share = desired_share
        self.discount = discount
        self.goals_only = goals_only
        self.relay = relay
        self.info_keys = tuple(info_keys)
        self.her_ratio = 1.0 if goals_only else 1 - 1 / (n_sampled_goal + 1)
        self.demos: HindsightReplayBuffer | None = None
        self.demo_share = 0.0
        self.random = np.random.default_rng(
            np.random.randint(2**31, size=4) if seed is None else seed
        )

        self._columns = entry_columns(observation_space)
        width = spaces.flatdim(observation_space)
        floats = np.issubdtype(action_space.dtype, np.floating)
        action_dtype = np.float32 if floats else action_space.dtype
        self.rows = np.zeros((n_rows, n_envs, width), np.float32)
        self.actions = np.zeros((n_rows, n_envs, self.action_dim), action_dtype)
        self.rewards = np.zeros((n_rows, n_envs), np.float32)
        self.terminated = np.zeros((n_rows, n_envs), bool)
        self.info_values = np.zeros((n_rows, n_envs, len(self.info_keys)), np.float32)
        # Steps from the beginning of the episode to this row, and from here to its last row.
        self.steps_before = np.zeros((n_rows, n_envs), np.int32)
        self.steps_left = np.zeros((n_rows, n_envs), np.int32)
        # Rows are counted without end; modulo n_rows it is where they lie. The oldest episode's
        # first row, the running episode's first row, and the row where it is now.
        self._cursors = np.zeros((3, n_envs), np.int64)
        # Of each ended episode in which the achieved goal moved: environment, first row, length.
        # Like the cursors it has fewer rows than the ring, so that a checkpoint keeps all of it.
        self._moved = np.zeros((3, 0), np.int64)
        self._judge_by(env)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the environment and its functions."""
        state = super().__getstate__()
        return state | {"_reward": None, "_termination": None}

    def set_env(self, env: VecEnv) -> None:
        """Judge goals by this environment, after unpickling."""
        super().set_env(env)
        self._judge_by(env)

    def use_demos(self, n_rows: int, share: float, seed: int) -> HindsightReplayBuffer:
        """Make a ring for demonstrations, which is drawn from in each batch, and return it.

        Args:
            n_rows: As many as their steps and episodes together.
            share: Of each batch.
            seed: Of the ring's generator.
        """
        self.demo_share = share
        self.demos = HindsightReplayBuffer(
            n_rows + _MIN_ROWS, self.observation_space, self.action_space, self.env,  # type: ignore[arg-type]
            self.device, n_sampled_goal=self.n_sampled_goal,
            goal_selection_strategy=self.strategy, moved_share=self.moved_share,
            desired_share=self.desired_share, discount=self.discount,
            goals_only=self.goals_only, relay=self.relay, info_keys=self.info_keys,
            seed=seed,
        )  # fmt: skip
        return self.demos

    def from_demos(self, n: int) -> np.ndarray:
        """Return which of n transitions that are drawn together are demonstrations.

        They are spread evenly, so that each of several batches has its share; and two by two, since
        of each two one may have the relay's goal.

        Shapes:
            result: ``(n,)``, of truth values.
        """
        pairs = np.arange(n) // 2
        return np.floor((pairs + 1) * self.demo_share) > np.floor(pairs * self.demo_share)

    def reset(self) -> None:
        """Forget everything but the demonstrations."""
        super().reset()
        self._cursors[:] = 0
        self._moved = self._moved[:, :0]

    def add(  # type: ignore[override]
        self,
        obs: dict[str, np.ndarray],
        next_obs: dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[Info],
    ) -> None:
        """Store one step of all environments.

        An observation that does not continue the running episode begins another: the environment
        was reset, or a step was not stored.

        Args:
            obs: What was acted on. Shapes: ``(n_envs, ...)`` per entry.
            next_obs: Where it led; for an episode that ended, its own last observation.
            action: Shapes: ``(n_envs, ...)``.
            reward: Shapes: ``(n_envs,)``.
            done: Whether the episode ended. Shapes: ``(n_envs,)``.
            infos: ``TimeLimit.truncated`` tells that an episode was only cut off.
        """
        everywhere = np.arange(self.n_envs)
        vectors, n_rows = self._to_vectors(obs, self.n_envs), self.buffer_size
        interrupted = (self.rows[self._cursors[_NOW] % n_rows, everywhere] != vectors).any(axis=1)
        self._end_episodes(interrupted)
        self._make_room()
        _, _, now = self._cursors
        here = (now % n_rows, everywhere)
        done = np.asarray(done, bool)
        self.rows[here] = vectors
        self.actions[here] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[here] = reward
        self.terminated[here], _ = decode_dones(done, infos)
        if self.info_keys:
            self.info_values[here] = [self._kept(info) for info in infos]
        now += 1
        self.rows[now % n_rows, everywhere] = self._to_vectors(next_obs, self.n_envs)
        self._end_episodes(done)
        n_used = int(now.max()) + 1
        self.full = n_used >= n_rows
        self.pos = n_used % n_rows if self.full else n_used

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        """Draw transitions in the form of Stable-Baselines3.

        Args:
            batch_size: Number of transitions.
            env: Normalizes observations and rewards.
        """
        batch = self.sample_vectors(batch_size, env)
        return DictReplayBufferSamples(
            **batch._asdict()
            | {
                "observations": self._to_entries(batch.observations),
                "next_observations": self._to_entries(batch.next_observations),
            }
        )

    def sample_vectors(
        self, batch_size: int, env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        """Draw transitions as tensors, observations as one vector each.

        Args:
            batch_size: Number of transitions.
            env: Normalizes observations and rewards.
        """
        batch = self.sample_arrays(batch_size, env)
        observations, actions, next_observations, rewards, terminated = (
            torch.as_tensor(array, device=self.device) for array in batch
        )
        return ReplayBufferSamples(
            observations=observations,
            actions=actions,
            next_observations=next_observations,
            dones=terminated.unsqueeze(1),
            rewards=rewards.unsqueeze(1),
        )

    def sample_arrays(self, batch_size: int, env: VecNormalize | None = None) -> Transitions:
        """Draw transitions uniformly from all ended episodes and relabel k / (k + 1) of them.

        Args:
            batch_size: Number of transitions; may be that of several batches, which are then
                independent of each other.
            env: Normalizes observations and rewards.

        Raises:
            RuntimeError: If no episode has ended yet.
        """
        if self.demos is None:
            return self._draw(batch_size, env)
        if self.demo_share == 1:
            return self.demos._draw(batch_size, env)
        chosen = self.from_demos(batch_size)
        own = self._draw(batch_size - int(chosen.sum()), env)
        shown = self.demos._draw(int(chosen.sum()), env)
        return Transitions(*(_merge(chosen, *pair) for pair in zip(shown, own, strict=True)))

    def _draw(self, batch_size: int, env: VecNormalize | None) -> Transitions:
        """Draw from this ring alone."""
        cells = self._draw_cells(batch_size)
        batch = Transitions(
            observations=self._rows_at(cells),
            actions=self.actions.reshape(-1, self.action_dim).take(cells, axis=0),
            next_observations=self._rows_at(self._later(cells, 1)),
            rewards=self.rewards.reshape(-1)[cells],
            terminated=self.terminated.reshape(-1)[cells].astype(np.float32),
        )
        (chosen,) = (self.random.random(batch_size) < self.her_ratio).nonzero()
        if len(chosen):
            self._relabel(batch, chosen, cells[chosen])
        if self.relay is not None:
            return self._with_first_goals(batch, cells, self.relay)
        if env is None:
            return batch
        return batch._replace(
            observations=self._normalized(batch.observations, env),
            next_observations=self._normalized(batch.next_observations, env),
            rewards=self._normalize_reward(batch.rewards, env),
        )

    def truncate_last_trajectory(self) -> None:
        """End the running episodes as if they had been cut off, so that they can be sampled."""
        self._end_episodes(np.ones(self.n_envs, bool))

    def _judge_by(self, env: VecEnv) -> None:
        if self.goals_only:
            return
        self._reward = goal_reward(env)
        self._termination = goal_termination(env)

    def _kept(self, info: Info) -> list[float]:
        for key in self.info_keys:
            if key not in info:
                raise EnvironmentFailure(
                    f"The info of a step has no '{key}', which {INFO_KEYS} names; the environment "
                    "must give it at each step."
                )
        return [info[key] for key in self.info_keys]

    def _end_episodes(self, ended: np.ndarray) -> None:
        """Close the running episodes of some environments; one without a step is none."""
        _, start, now = self._cursors
        for index in (ended & (now > start)).nonzero()[0]:
            length = now[index] - start[index]
            rows = np.arange(start[index], now[index] + 1) % self.buffer_size
            self.steps_before[rows, index] = np.arange(length + 1)
            self.steps_left[rows, index] = np.arange(length, -1, -1)
            reached = self.rows[rows, index, self._columns["achieved_goal"]]
            if np.ptp(reached, axis=0).max() > _REST:
                episode = [[index], [start[index]], [length]]
                self._moved = np.hstack([self._moved, episode])
            now[index] += 1
            start[index] = now[index]

    def _make_room(self) -> None:
        """Drop the oldest episodes where the next two rows would be written into them."""
        oldest, start, now = self._cursors
        dropped = False
        while len(short := (oldest + self.buffer_size <= now + 1).nonzero()[0]):
            dropped = True
            for index in short:
                if oldest[index] < start[index]:
                    row = oldest[index] % self.buffer_size
                    oldest[index] += self.steps_left[row, index] + 1
                else:  # an episode longer than the ring forgets its first step
                    oldest[index] += 1
                    start[index] += 1
        if dropped:
            env, first, _ = self._moved
            self._moved = self._moved[:, first >= oldest[env]]

    def _relabel(self, batch: Transitions, chosen: np.ndarray, cells: np.ndarray) -> None:
        """Put other goals into the chosen transitions, which come from these cells."""
        goals = self._draw_goals(cells)
        wanted, reached = self._columns["desired_goal"], self._columns["achieved_goal"]
        batch.observations[chosen, wanted] = goals
        batch.next_observations[chosen, wanted] = goals
        if self.goals_only:
            batch.rewards[chosen] = batch.terminated[chosen] = 0.0
            return
        shape = (-1, *self.obs_shape["desired_goal"])
        achieved = batch.next_observations[chosen, reached].reshape(shape)
        pairs = achieved, goals.reshape(shape), self._infos(cells)
        batch.rewards[chosen] = self._reward(*pairs)
        if self._termination is not None:
            try:
                batch.terminated[chosen] = self._termination(*pairs)
            except NotImplementedError:  # the base class of Gymnasium-Robotics does not say
                self._termination = None

    def _with_first_goals(self, batch: Transitions, cells: np.ndarray, relay: Relay) -> Transitions:
        """Give every other transition the first goal of the relay, and flag it."""
        flags = np.arange(len(cells)) % 2  # half of each batch, however many were drawn at once
        chosen = flags.nonzero()[0]
        here = cells[chosen]
        goals = self._rows_at(here)[:, relay.object]
        (relabeled,) = (self.random.random(len(chosen)) < self.her_ratio).nonzero()
        steps = self._draw_steps(self.steps_left.reshape(-1)[here[relabeled]])
        later = self._rows_at(self._later(here[relabeled], steps))
        goals[relabeled] = later[:, relay.effector]
        relay.set_goals(batch.observations, chosen, goals)
        relay.set_goals(batch.next_observations, chosen, goals)
        batch.rewards[chosen] = relay.rewards(batch.next_observations[chosen], goals)
        batch.terminated[chosen] = 0.0
        return batch._replace(
            observations=relay.with_flag(batch.observations, flags),
            next_observations=relay.with_flag(batch.next_observations, flags),
        )

    def _draw_cells(self, n: int) -> np.ndarray:
        """Draw transitions: places in the arrays without their first two axes. Shapes: ``(n,)``."""
        oldest, start, _ = self._cursors
        ends = np.cumsum(start - oldest)
        if ends[-1] == 0:
            raise RuntimeError(
                "No episode has ended yet, so there is nothing to sample; algorithm.learning_starts"
                " must be greater than the longest episode times the number of environments."
            )
        cells = np.empty(n, np.int64)
        from_moved = np.zeros(n, bool)
        if self.moved_share and self._moved.size:
            from_moved = self.random.random(n) < self.moved_share
            cells[from_moved] = self._draw_moved_cells(int(from_moved.sum()))
        (missing,) = (~from_moved).nonzero()
        while len(missing):
            drawn = self.random.integers(ends[-1], size=len(missing))
            env = np.searchsorted(ends, drawn, side="right")
            cells[missing] = self._cell(env, drawn - ends[env] + start[env])
            # The last row of an episode begins no transition.
            missing = missing[self.steps_left.reshape(-1)[cells[missing]] == 0]
        return cells

    def _draw_moved_cells(self, n: int) -> np.ndarray:
        """Draw transitions of episodes in which the achieved goal moved. Shapes: ``(n,)``."""
        env, first, length = self._moved
        ends = np.cumsum(length)
        drawn = self.random.integers(ends[-1], size=n)
        episode = np.searchsorted(ends, drawn, side="right")
        step = drawn - (ends - length)[episode]
        return self._cell(env[episode], first[episode] + step)

    def _cell(self, env: np.ndarray, row: np.ndarray) -> np.ndarray:
        return row % self.buffer_size * self.n_envs + env

    def _draw_goals(self, cells: np.ndarray) -> np.ndarray:
        """Draw a goal for each transition. Shapes: ``(batch, goal_size)``."""
        left = self.steps_left.reshape(-1)[cells]
        before = self.steps_before.reshape(-1)[cells]
        if self.strategy == "random":
            reached = self._later(self._draw_cells(len(cells)), 1)
        elif self.strategy == "final":
            reached = self._later(cells, left)
        elif self.strategy == "future":
            reached = self._later(cells, self._draw_steps(left))
        elif self.strategy == "geometric":
            reached = self._later(cells, self._draw_discounted_steps(left))
        else:
            reached = self._later(cells, self._draw_steps(before + left) - before)
        goals = self._rows_at(reached)[:, self._columns["achieved_goal"]]
        if self.desired_share:
            (replaced,) = (self.random.random(len(cells)) < self.desired_share).nonzero()
            asked = self._rows_at(self._draw_cells(len(replaced)))
            goals[replaced] = asked[:, self._columns["desired_goal"]]
        return goals

    def _draw_steps(self, most: np.ndarray) -> np.ndarray:
        """Draw numbers from 1 to ``most``."""
        return 1 + (self.random.random(len(most)) * most).astype(np.int64)

    def _draw_discounted_steps(self, most: np.ndarray) -> np.ndarray:
        """Draw numbers k from 1 to ``most`` with P(k) in proportion to discount^(k - 1)."""
        chance = self.random.random(len(most)) * (1 - self.discount**most)
        steps = 1 + (np.log1p(-chance) / np.log(self.discount)).astype(np.int64)
        return np.minimum(steps, most)  # rounding

    def _rows_at(self, cells: np.ndarray) -> np.ndarray:
        return self.rows.reshape(-1, self.rows.shape[2]).take(cells, axis=0)

    def _later(self, cells: np.ndarray, steps: np.ndarray | int) -> np.ndarray:
        return (cells + steps * self.n_envs) % (self.buffer_size * self.n_envs)

    def _infos(self, cells: np.ndarray) -> list[Info]:
        if not self.info_keys:
            return [{}] * len(cells)
        values = self.info_values.reshape(-1, len(self.info_keys))[cells]
        return [dict(zip(self.info_keys, row, strict=True)) for row in values]

    def _to_vectors(self, entries: Mapping[str, np.ndarray], n: int) -> np.ndarray:
        """Join the entries of n observations. Shapes: ``(n, n_observations)``."""
        parts = [np.asarray(entries[key]).reshape(n, -1) for key in self._columns]
        return np.concatenate(parts, axis=1, dtype=np.float32, casting="same_kind")

    def _to_entries(self, vectors: V) -> dict[str, V]:
        """Divide vectors, arrays or tensors, into entries."""
        return {
            key: vectors[:, columns].reshape(-1, *self.obs_shape[key])
            for key, columns in self._columns.items()
        }

    def _normalized(self, vectors: np.ndarray, env: VecNormalize) -> np.ndarray:
        normalized: Any = env.normalize_obs(self._to_entries(vectors))
        return self._to_vectors(normalized, len(vectors))


def _merge(chosen: np.ndarray, some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return ``some`` at the chosen places, in their order, and ``others`` at the rest."""
    merged = np.empty((len(chosen), *others.shape[1:]), others.dtype)
    merged[chosen], merged[~chosen] = some, others
    return merged


def _check_shares(**shares: float) -> None:
    for name, share in shares.items():
        if not 0 <= share <= 1:
            raise ConfigError(
                f"algorithm.replay_buffer_kwargs.{name} must be from 0 to 1, but it is {share}."
            )


def _check(space: spaces.Space, n_sampled_goal: int, strategy: str) -> None:
    if not can_hold(space):
        raise ConfigError(
            "This replay buffer needs Dict observations of floating-point arrays with observation, "
            "achieved_goal and desired_goal; add ++algorithm.replay_buffer_class=her or =null."
        )
    if n_sampled_goal < 0:
        raise ConfigError(
            "algorithm.replay_buffer_kwargs.n_sampled_goal must be at least 0, but it is "
            f"{n_sampled_goal}."
        )
    if strategy not in GOAL_STRATEGIES:
        raise ConfigError(
            "algorithm.replay_buffer_kwargs.goal_selection_strategy must be one of "
            f"{listing(GOAL_STRATEGIES)}, but it is {strategy!r}."
            f"{did_you_mean(str(strategy), GOAL_STRATEGIES)}"
        )


def entry_columns(space: spaces.Dict) -> dict[str, slice]:
    """Return where each entry is in the vector of an observation."""
    columns, start = {}, 0
    for key, entry in space.spaces.items():
        columns[key] = slice(start, start + spaces.flatdim(entry))
        start = columns[key].stop
    return columns
