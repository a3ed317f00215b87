"""The one evaluation loop: used between epochs, at the end, and to play a trained policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_wrapper

from scilab_rl.envs.goal_setting import EpisodePlan
from scilab_rl.envs.observed import ObservedVecEnv
from scilab_rl.learning.algorithm import Policy
from scilab_rl.metrics.success import episode_outcomes, success_metrics, success_of


@dataclass
class Episode:
    """The rewards and the success of one episode.

    Attributes:
        rewards: Reward of each step.
        success: Success that the last step reported; None when it reported none.
        success_once: Success at any step; None when no step reported any.
    """

    rewards: list[float] = field(default_factory=list)
    success: bool | None = None
    success_once: bool | None = None

    def add(self, reward: float, info: dict[str, object]) -> None:
        """Add a step."""
        self.rewards.append(float(reward))
        self.success = success_of(info)
        if self.success is not None:
            self.success_once = bool(self.success_once) or self.success


@dataclass(frozen=True)
class Evaluation:
    """The episodes of one evaluation."""

    episodes: list[Episode]

    @property
    def reports_success(self) -> bool:
        """Whether any step of any episode reported success or failure."""
        return any(episode.success_once is not None for episode in self.episodes)

    @property
    def reported(self) -> list[bool | None]:
        """The success that each episode reported at its end."""
        return [episode.success for episode in self.episodes]

    def metrics(self, prefix: str = "eval", *, reports_success: bool = False) -> dict[str, float]:
        """Return the means over the episodes, named as Stable-Baselines3 names them.

        Args:
            prefix: Section of the names.
            reports_success: Whether the task is known to report success, from other episodes: one
                that reports it only when it succeeds says nothing about a failure.
        """
        values = {
            "mean_reward": float(np.mean([sum(e.rewards) for e in self.episodes])),
            "mean_ep_length": float(np.mean([len(e.rewards) for e in self.episodes])),
            "rollout_rewards_step": self.episodes[-1].rewards[-1],
        }
        known = reports_success or self.reports_success
        outcomes = episode_outcomes(self.reported, reports_success=known)
        if outcomes is not None:
            values |= success_metrics(outcomes, self.reported)
            values["success_once_rate"] = float(
                np.mean([bool(e.success_once) for e in self.episodes])
            )
        return {f"{prefix}/{name}": value for name, value in values.items()}


def evaluate(
    policy: Policy,
    env: VecEnv,
    n_episodes: int,
    seed: int,
    *,
    deterministic: bool = True,
    on_episode: Callable[[Episode], None] | None = None,
) -> Evaluation:
    """Let a policy act for some episodes.

    The result is a function of the policy's weights and the seed alone: neither an earlier
    evaluation nor the training environments matter.

    Args:
        policy: Policything with Stable-Baselines3's ``predict``.
        env: A vector environment with one environment.
        n_episodes: How many episodes, at least 1.
        seed: Seed of the first episode; the others follow from it.
        deterministic: Whether the policy's mean action is taken.
        on_episode: Called after each episode.
    """
    env.seed(seed)
    [episodes] = _play(policy, env, [n_episodes], deterministic, on_episode or _ignore)
    return Evaluation(episodes)


def evaluate_side_by_side(
    policy: Policy,
    env: VecEnv,
    plans: Sequence[Sequence[EpisodePlan]],
    n_episodes: Sequence[int],
    *,
    deterministic: bool = True,
    on_episode: Callable[[Episode], None] | None = None,
) -> list[list[Episode]]:
    """Let a policy act in several environments at once, which is faster by far.

    Each environment has its own chance and its own episodes, so that which environments are next to
    it changes nothing but the last bits of what networks compute for a larger batch.

    Args:
        policy: As in `evaluate`.
        env: A vector environment of `make_eval_env`.
        plans: For each environment, how its first episodes begin; later ones begin by its chance.
        n_episodes: For each environment, how many episodes.
        deterministic: Whether the policy's mean action is taken.
        on_episode: Called after each episode.

    Returns:
        The episodes of each environment, in order.
    """
    for index, planned in enumerate(plans):
        env.env_method("plan_episodes", list(planned), indices=[index])
    return _play(policy, env, n_episodes, deterministic, on_episode or _ignore)


def evaluate_seeds(
    policy: Policy, env: VecEnv, n_episodes: int, seeds: Sequence[int]
) -> list[Evaluation]:
    """Evaluate with several seeds side by side: the episodes of `evaluate` with each of them.

    Args:
        policy: As in `evaluate`.
        env: A vector environment of `make_eval_env` with one environment for each seed.
        n_episodes: Episodes of each seed.
        seeds: One for each environment.
    """
    plans = [[EpisodePlan(seed)] for seed in seeds]
    played = evaluate_side_by_side(policy, env, plans, [n_episodes] * len(seeds))
    return [Evaluation(episodes) for episodes in played]


def _play(
    policy: Policy,
    env: VecEnv,
    n_episodes: Sequence[int],
    deterministic: bool,
    on_episode: Callable[[Episode], None],
) -> list[list[Episode]]:
    observation = env.reset()
    # Layers above it may change rewards.
    task = unwrap_vec_wrapper(env, ObservedVecEnv)
    episodes: list[list[Episode]] = [[] for _ in n_episodes]
    running = [Episode() for _ in n_episodes]
    state, starts = None, np.ones(env.num_envs, dtype=bool)
    missing = sum(n_episodes)
    while missing:
        action, state = policy.predict(
            observation, state=state, episode_start=starts, deterministic=deterministic
        )
        observation, rewards, starts, infos = env.step(action)
        rewards = rewards if task is None else task.task_rewards
        for index, info in enumerate(infos):
            if len(episodes[index]) == n_episodes[index]:  # waits for the others
                continue
            running[index].add(rewards[index], info)
            if starts[index]:
                episodes[index].append(running[index])
                on_episode(running[index])
                running[index] = Episode()
                missing -= 1
    return episodes


def _ignore(episode: Episode) -> None:
    pass
