"""Demonstrations for off-policy learning: where they come from, and into which ring they go.

Vecerik et al., 2017, arXiv 1707.08817, and Nair et al., 2018, arXiv 1709.10089, keep demonstrations
next to what the agent experiences, and draw a share of each batch from them. Here they lie in a
ring of the hindsight replay buffer. They are collected once, before the first step; a checkpoint
has them, so that a resumed run needs neither their source nor the time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl.config.schema import RunConfig
from scilab_rl.errors import ConfigError, MissingDependencyError, did_you_mean
from scilab_rl.learning.arguments import DEMOS
from scilab_rl.metrics.success import success_of
from scilab_rl.run.directory import CONFIG_FILE, find_policy, find_run
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:  # heavy
    import gymnasium as gym

    from scilab_rl.envs.types import Info, Observation
    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.learning.replay import HindsightReplayBuffer

_KINDS = ("scripted", "run", "minari")
_SETTINGS = ("source", "share")
_EXAMPLES = "scripted:100, run:RUN, run:RUN:100 or minari:ID"
_N_EPISODES = 100  # of a run, by default
_MOST_TRIES = 50  # per demonstration: what succeeds so rarely is not one
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Step:
    """One step of a demonstration, in the environment's own units."""

    observation: Observation
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    info: Info
    next_observation: Observation


@dataclass(frozen=True)
class DemoSettings:
    """The key ``algorithm.demos``.

    Attributes:
        kind: ``scripted``, ``run`` or ``minari``.
        name: Of the run or the data set.
        n_episodes: How many; 0: all of a data set.
        share: Of each batch.
    """

    kind: str
    name: str
    n_episodes: int
    share: float


def parse_demos(chosen: object) -> DemoSettings:
    """Read ``algorithm.demos``: a source, or a mapping with ``source`` and ``share``.

    Raises:
        ConfigError: If it is neither.

    >>> parse_demos("scripted:100")
    DemoSettings(kind='scripted', name='', n_episodes=100, share=0.5)
    >>> parse_demos({"source": "run:agent:FetchPush:20", "share": 0.25})
    DemoSettings(kind='run', name='agent:FetchPush', n_episodes=20, share=0.25)
    """
    settings = dict(chosen) if isinstance(chosen, Mapping) else {"source": chosen}
    for key in settings:
        if key not in _SETTINGS:
            raise ConfigError(
                f"There is no algorithm.demos.{key}.{did_you_mean(str(key), _SETTINGS)} There are "
                "source and share."
            )
    share = settings.get("share", 0.5)
    if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0 < share < 1:
        raise ConfigError(
            f"algorithm.demos.share must be a number between 0 and 1, but it is {share!r}."
        )
    source = str(settings.get("source"))
    kind, _, rest = source.partition(":")
    name, _, number = rest.rpartition(":")
    if kind != "scripted" and not (name and number.isdigit()):
        name, number = rest, str(_N_EPISODES if kind == "run" else 0)
    is_whole = number.isdigit() and (kind == "minari" or int(number) > 0)
    if kind not in _KINDS or not rest or not is_whole or (kind == "scripted" and name):
        raise ConfigError(
            f"algorithm.demos must be {_EXAMPLES}, but it is {source!r}."
            f"{did_you_mean(kind, _KINDS)}"
        )
    return DemoSettings(kind, name, int(number), float(share))


def prepare_demos(cfg: RunConfig, algorithm: Algorithm) -> None:
    """Make an empty ring for the demonstrations that a configuration names, if it names any.

    Raises:
        ConfigError: If the algorithm or the environment cannot use them.
    """
    from scilab_rl.learning.replay import HindsightReplayBuffer

    chosen = cfg.algorithm.arguments.get(DEMOS)
    if chosen is None:
        return
    settings, buffer = parse_demos(chosen), getattr(algorithm, "replay_buffer", None)
    if not isinstance(buffer, HindsightReplayBuffer):
        raise ConfigError(
            f"algorithm.demos needs our own hindsight replay, which {cfg.algorithm.name} does not "
            f"have in {cfg.env}; use an environment with goals and "
            "++algorithm.replay_buffer_class=auto, or algorithm.demos=null."
        )
    seed = derive_seed(cfg.seed, "demos")
    buffer.use_demos(_n_rows(settings, algorithm), settings.share, seed)


def collect_demos(cfg: RunConfig, algorithm: Algorithm) -> None:
    """Fill the ring of `prepare_demos`, if there is one.

    Raises:
        ConfigError: If the source does not exist or gives too few demonstrations.
    """
    ring = getattr(getattr(algorithm, "replay_buffer", None), "demos", None)
    if ring is None:
        return
    settings, n_episodes, n_steps = parse_demos(cfg.algorithm.arguments[DEMOS]), 0, 0
    for episode in _episodes(settings, cfg):
        for step in episode:
            _store(ring, algorithm, step)
        ring.truncate_last_trajectory()
        n_episodes, n_steps = n_episodes + 1, n_steps + len(episode)
    normalizer = getattr(algorithm, "normalizer", None)
    if normalizer is not None:
        normalizer.update(ring.rows[: n_steps + n_episodes, 0])
    _log.info("%d demonstrations with %d steps from %s.", n_episodes, n_steps, settings.kind)


def _n_rows(settings: DemoSettings, algorithm: Algorithm) -> int:
    """Return how many rows the demonstrations take at most."""
    from scilab_rl.learning.compatibility import longest_episode

    if settings.kind == "minari":
        data = _data_set(settings.name)
        return int(data.total_steps + data.total_episodes)
    longest = longest_episode(algorithm.get_env())
    assert longest is not None  # hindsight replay needs a step limit
    return settings.n_episodes * (longest + 1)


def _store(ring: HindsightReplayBuffer, algorithm: Any, step: Step) -> None:
    from scilab_rl.canonical_spaces import conversions
    from scilab_rl.learning.observations import batch_of_one

    actions = conversions(algorithm.get_env())[0].from_env(np.asarray(step.action)[None])
    if hasattr(algorithm, "from_env_actions"):
        actions = algorithm.from_env_actions(actions)
    elif hasattr(algorithm.action_space, "low"):  # of Stable-Baselines3
        actions = algorithm.policy.scale_action(actions)
    info = {**step.info, "TimeLimit.truncated": step.truncated and not step.terminated}
    observation: Any = batch_of_one(step.observation)
    next_observation: Any = batch_of_one(step.next_observation)
    done = np.array([step.terminated or step.truncated])
    ring.add(observation, next_observation, actions, np.array([step.reward]), done, [info])


def _episodes(settings: DemoSettings, cfg: RunConfig) -> Iterator[list[Step]]:
    if settings.kind == "minari":
        return _stored_episodes(settings)
    if settings.kind == "run":
        return _episodes_of_run(settings, cfg)
    return _scripted_episodes(settings, cfg)


def _scripted_episodes(settings: DemoSettings, cfg: RunConfig) -> Iterator[list[Step]]:
    from scilab_rl.envs.scripted import controller_for
    from scilab_rl.envs.vectorize import make_single_env

    env = make_single_env(cfg)
    try:
        controller = controller_for(env)
        yield from _successes(settings, cfg, env, controller.act, controller.begin)
    finally:
        env.close()


def _episodes_of_run(settings: DemoSettings, cfg: RunConfig) -> Iterator[list[Step]]:
    from scilab_rl.canonical_spaces import conversions
    from scilab_rl.config.recorded import load_recorded
    from scilab_rl.envs.vectorize import make_single_env
    from scilab_rl.learning.inspector import observation_functions
    from scilab_rl.learning.observations import batch_of_one
    from scilab_rl.run.player import load_player

    run = find_run(settings.name, Path(cfg.base_logdir))
    theirs = load_recorded(run / CONFIG_FILE)
    if (theirs.env, dict(theirs.env_kwargs)) != (cfg.env, dict(cfg.env_kwargs)):
        raise ConfigError(
            f"algorithm.demos: {run} was trained in {theirs.env}, which is not {cfg.env} with "
            "these env_kwargs; name a run of the same environment."
        )
    saved = find_policy(run, settings.name, "best", "finished")
    their_env, model = load_player(theirs, saved, record=False)
    functions, to_env = observation_functions(their_env), conversions(their_env)[0].to_env

    def act(observation: Any) -> Any:
        batch = batch_of_one(observation)
        for function in functions:
            batch = function(batch)
        return to_env(model.predict(batch, deterministic=True)[0])[0]

    env = make_single_env(theirs)
    try:
        yield from _successes(settings, cfg, env, act)
    finally:
        env.close()
        their_env.close()


def _successes(
    settings: DemoSettings,
    cfg: RunConfig,
    env: gym.Env,
    act: Callable[[Any], Any],
    begin: Callable[[], None] = lambda: None,
) -> Iterator[list[Step]]:
    """Yield episodes that end in success; all of them where the task does not report it."""
    seed: int | None = derive_seed(cfg.seed, "demos")
    n_found = 0
    for n_tries in range(1, _MOST_TRIES * settings.n_episodes + 1):
        begin()
        episode = _play(env, act, seed)
        seed = None
        if success_of(episode[-1].info) is False:
            continue
        yield episode
        n_found += 1
        if n_found == settings.n_episodes:
            _log.info("%d of %d episodes were successful.", n_found, n_tries)
            return
    raise ConfigError(
        f"algorithm.demos: only {n_found} of {n_tries} episodes were successful, and "
        f"{settings.n_episodes} demonstrations are wanted; take another source."
    )


def _play(env: gym.Env, act: Callable[[Any], Any], seed: int | None) -> list[Step]:
    observation, _ = env.reset(seed=seed)
    steps: list[Step] = []
    while not steps or not (steps[-1].terminated or steps[-1].truncated):
        action = np.asarray(act(observation), env.action_space.dtype)
        after, reward, terminated, truncated, info = env.step(action)
        steps.append(Step(observation, action, float(reward), terminated, truncated, info, after))
        observation = after
    return steps


def _data_set(name: str) -> Any:
    """Return a Minari data set that is on this machine.

    Raises:
        ConfigError: If it is not here.
        MissingDependencyError: If Minari is not installed.
    """
    try:
        import minari

        return minari.load_dataset(name)
    except ImportError as error:  # Minari, or what reads its files
        raise MissingDependencyError("minari", "minari", "to read demonstrations") from error
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"algorithm.demos: there is no Minari data set '{name}' on this machine; get it with: "
            f"minari download {name}"
        ) from error


def _stored_episodes(settings: DemoSettings) -> Iterator[list[Step]]:
    for number, episode in enumerate(_data_set(settings.name).iterate_episodes()):
        if settings.n_episodes and number == settings.n_episodes:
            return
        observations = episode.observations
        if not isinstance(observations, dict) or "desired_goal" not in observations:
            raise ConfigError(
                f"algorithm.demos: the observations of '{settings.name}' have no goals."
            )
        rows = [
            {key: observations[key][i] for key in ("observation", "achieved_goal", "desired_goal")}
            for i in range(len(episode.actions) + 1)
        ]
        yield [
            Step(rows[i], action, float(episode.rewards[i]), bool(episode.terminations[i]),
                 bool(episode.truncations[i]), {}, rows[i + 1])
            for i, action in enumerate(episode.actions)
        ]  # fmt: skip
